"""States of the poses of a replay, its timing, and light that changes."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
import pytest

from calib import se3
from calib.rig_file import read_rig
from omnid.api import replay
from omnid.formats.tum import Trajectory, read_tum
from omnid.transport.codec import decode_diagnostics, decode_pose
from omnid.transport.status_names import ODOMETRY
from tests.conftest import PAIRS
from tests.replay.command import Command, recorded, rows
from tests.replay.edited import Image, Pixels, dark, images, repeat_lines, roll, save, shift, tear, turn
from tests.simulation import build, write_log
from tests.simulation.logs import Readout

DARK_PAIRS = 20  # pairs, 2 s


def states(path: Path) -> list[tuple[str, int]]:
    """Return state and reset counter whenever they change."""
    found = []
    for message in recorded(path, "/omnid/status"):
        status = decode_diagnostics(message).statuses[0]
        if status.name == ODOMETRY:
            found.append((status.values["state"], int(status.values["resets"])))
    return found


def sigmas_m(log: Path) -> np.ndarray:
    """Return the standard deviations of the recorded positions."""
    return np.array([np.trace(decode_pose(pose).covariance[:3, :3]) for pose in recorded(log, "/omnid/odom")]) ** 0.5


def errors_m(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    a, b = (se3.inverse(t.T[0]) @ t.T for t in (estimate, truth))
    return np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)


def test_a_camera_without_images_for_a_second_leaves_one_degraded_pose(
    omnid: Command, tmp_path: Path, scene: Path
) -> None:
    taken = [p for p in images(scene / "log.mcap") if p.camera == "lower" or not 7 <= p.pair < 17]
    log = save(tmp_path / "log.mcap", taken)
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert result.count("unpaired_lower") == 10 and result.count("pairs") == PAIRS - 10
    assert states(tmp_path / "out.mcap") == [("tracking", 0), ("degraded", 0), ("tracking", 0)]
    truth = read_tum(scene / "truth.txt")
    seen = [*range(7), *range(17, PAIRS)]
    assert errors_m(read_tum(tmp_path / "est"), Trajectory(truth.stamps_ns[seen], truth.T[seen])).max() < 0.02


def test_a_pose_lost_in_two_seconds_of_darkness_is_found_again(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    before, last_pair = [p for p in taken if p.pair < 12], [p for p in taken if p.pair == 11]
    dark_images = [dark(p.later(1 + k)) for k in range(DARK_PAIRS) for p in last_pair]
    later = [p.later(DARK_PAIRS) for p in taken if p.pair >= 12]
    log = save(tmp_path / "log.mcap", [*before, *dark_images, *later])
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert result.code == 0 and len(rows(tmp_path / "est")) == PAIRS + DARK_PAIRS
    found = states(tmp_path / "out.mcap")
    assert ("lost", 0) in found and found[-1] == ("tracking", 0)
    sigma_m = sigmas_m(tmp_path / "out.mcap")
    assert (np.diff(sigma_m[13 : 11 + DARK_PAIRS]) > 0).all() and sigma_m[10 + DARK_PAIRS] > 10 * sigma_m[11]
    assert sigma_m[-1] < 0.02
    estimate, truth = read_tum(tmp_path / "est"), read_tum(scene / "truth.txt")
    seen = [*range(12), *range(12 + DARK_PAIRS, PAIRS + DARK_PAIRS)]
    assert errors_m(Trajectory(estimate.stamps_ns[seen], estimate.T[seen]), truth).max() < 0.02


@pytest.mark.parametrize("cameras", [("lower", "upper"), ("upper",)])
def test_poses_are_lost_while_images_have_no_texture_and_tracked_after_it(
    omnid: Command, tmp_path: Path, scene: Path, cameras: tuple[str, ...]
) -> None:
    """The blank images differ by grey levels, so that no camera counts as frozen."""

    def blank(image: Image) -> Image:
        grey = np.full(read_rig(scene / "rig.toml").lower.camera.size[::-1], 8 * image.pair, np.uint8)
        return replace(image, jpeg=cv2.imencode(".jpg", grey)[1].tobytes())

    taken = images(scene / "log.mcap")
    log = save(tmp_path / "log.mcap", [blank(p) if p.pair < 5 and p.camera in cameras else p for p in taken])
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    assert result.code == 0 and "Traceback" not in result.err
    found = [state for state, _ in states(tmp_path / "out.mcap")]
    assert found[0] == "lost" and found[-1] == "tracking"


def test_odometry_begins_again_in_another_scene_after_the_dark(
    omnid: Command, tmp_path: Path, scene: Path, elsewhere: Path
) -> None:
    before, after = images(scene / "log.mcap"), images(elsewhere / "log.mcap")
    dark_images = [dark(p.later(1 + k)) for k in range(DARK_PAIRS) for p in before[:2]]
    log = save(tmp_path / "log.mcap", [*before[:2], *dark_images, *(p.later(1 + DARK_PAIRS) for p in after)])
    omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    found = states(tmp_path / "out.mcap")
    assert found[-1] == ("tracking", 1)
    assert sigmas_m(tmp_path / "out.mcap")[-1] > 0.5  # the gap stays in the covariance


def test_exchanged_cameras_end_tracking_and_are_named(omnid: Command, tmp_path: Path, scene: Path) -> None:
    """The lower camera alone tracks on, 0.2 m too high, and stereo of exchanged images finds points by chance."""
    other = {"lower": "upper", "upper": "lower"}
    taken = [p if p.pair < 6 else replace(p, camera=other[p.camera]) for p in images(scene / "log.mcap")]
    log = save(tmp_path / "log.mcap", taken)
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    assert "is --lower the lower one" in result.err
    found = states(tmp_path / "out.mcap")
    assert found[0] == ("tracking", 0) and "lost" in dict(found)
    assert "tracking" not in dict(found[1:])


# Images that are torn, displaced, or have lines twice or missing: a warning names them, and no pose is sure


Edit = Callable[[Sequence[Pixels]], list[Pixels]]
SINCE: Final = 8
SIGMAS: Final = 3.0
LEAST_M: Final = 0.005  # of an error beside which a pose may be called sure


class Case(NamedTuple):
    """The cameras whose images are edited, how, from which pair on, and a pattern of the warning that names it."""

    cameras: tuple[Literal["lower", "upper"], ...]
    edit: Edit
    line: str
    since: int = SINCE


BOTH: Final = ("lower", "upper")
CASES: Final = {
    "torn, one camera": Case(
        ("lower",), lambda taken: tear(taken, 128, since=SINCE), "the lower camera are torn at row"
    ),
    "torn, both": Case(BOTH, lambda taken: tear(taken, 100, since=SINCE), "the upper cameras are torn at row"),
    "displaced, one camera": Case(
        ("upper",), lambda taken: shift(taken, (0, -4), since=SINCE), r"camera were displaced by \S+, -(3\.[89]|4\.)"
    ),
    "displaced by a row, both": Case(
        BOTH, lambda taken: shift(taken, (0, 1), since=SINCE), r"cameras were displaced by \S+, \+(0\.[89]|1\.)"
    ),
    "lines missing": Case(
        BOTH, lambda taken: repeat_lines(taken, 128, -4, since=SINCE), "displaced by .* px below row 1[123]"
    ),
    "a mirror has moved": Case(
        ("lower",),
        lambda taken: turn(taken, 1.0, since=SINCE),
        r"the lower camera were displaced by .* turned by -(0\.9|1\.0)",
    ),
    # The first image is not rolled, and left out.
    "lines of both read one after another": Case(
        BOTH, roll, r"cameras have rows that .* line time about -[345]\d\d us .* set", since=0
    ),
}


def _decoded(jpeg: bytes) -> Pixels:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)


def edited(log: Path, case: Case) -> Path:
    """Write a log with the images of a case beside another one; all of its images are edited where since is 0."""
    taken = images(log)
    for camera in case.cameras:
        own = [number for number, image in enumerate(taken) if image.camera == camera]
        pixels = [_decoded(taken[n].jpeg) for n in own]
        for number, image in zip(own, case.edit(pixels), strict=True):
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            taken[number] = replace(taken[number], jpeg=jpeg)
    return save(log.with_name("edited.mcap"), (image for image in taken if case.since or image.pair))


@pytest.mark.parametrize("name", CASES)
def test_a_broken_image_is_named_and_no_pose_of_it_is_sure(course: Path, tmp_path: Path, name: str) -> None:
    case = CASES[name]
    result = replay(edited(course / "log.mcap", case), course / "rig.toml", overrides=["places.enabled=false"])
    warned = [line for line in result.warnings if line.startswith("images of the ")]
    assert any(re.search(case.line, line) for line in warned), result.warnings
    assert len(warned) <= 4
    truth = read_tum(course / "truth.txt")
    T_true = truth.T[len(truth.T) - len(result.T_odom_rig) :]
    T_true = se3.inverse(T_true[0]) @ T_true
    error_m = np.linalg.norm(result.T_odom_rig[:, :3, 3] - T_true[:, :3, 3], axis=1)
    sigma_m = np.sqrt(np.array([np.linalg.eigvalsh(each[:3, :3])[-1] for each in result.covariances]))
    sure = np.array([state == "tracking" for state in result.states])
    assert not (sure & (error_m > np.maximum(LEAST_M, SIGMAS * sigma_m))).any(), (error_m, sigma_m, result.states)
    if case.since:
        assert sure[: case.since].all()


def test_whole_images_are_not_suspected(course: Path) -> None:
    result = replay(course / "log.mcap", course / "rig.toml", overrides=["places.enabled=false"])
    assert not [line for line in result.warnings if line.startswith("images of the ")]
    assert set(map(str, result.states)) == {"tracking"}


def test_cameras_of_a_shaken_rig_that_are_not_synchronised_have_whole_images(tmp_path: Path) -> None:
    """Both flows are off in one way where the velocity between the exposures is not known exactly."""
    made, readout = build("rooms", 9, 256, 100), Readout(1.4, (15.0, 15.0))
    poses = made.poses[:16]
    write_log(tmp_path, made.rig, poses, made.scene, seed=9, sensor=made.sensor, readout=readout)
    result = replay(tmp_path / "log.mcap", tmp_path / "rig.toml", overrides=["places.enabled=false"])
    assert set(result.states) == {"tracking"}, result.warnings
