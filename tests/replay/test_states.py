"""States of the poses of a replay, its timing, and light that changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

import omnid
from calib import se3
from calib.rig import ShutterTimes
from calib.rig_file import read_rig
from omnid.api import replay
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.tracking_state import TrackingState
from omnid.transport.codec import Pose, decode_pose
from omnid.transport.status_names import ODOMETRY
from tests.conftest import PAIRS
from tests.drivers.logs.mcap_logs import STORE
from tests.replay.command import Command, rows
from tests.replay.edited import Image, dark, images, save
from tests.simulation import build, write_log
from tests.simulation.logs import Readout

DARK_PAIRS = 20  # pairs, 2 s


def recorded(path: Path) -> list[Pose]:
    with path.open("rb") as file:
        return [decode_pose(m.data) for _, _, m in make_reader(file).iter_messages(["/omnid/odom"])]


def states(path: Path) -> list[tuple[str, int]]:
    """Return state and reset counter whenever they change."""
    found = []
    with path.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(["/omnid/status"]):
            status = STORE.deserialize_cdr(message.data, schema.name).status[0]
            values = {pair.key: pair.value for pair in status.values}
            if status.name == ODOMETRY:
                found.append((values["state"], int(values["resets"])))
    return found


def errors_m(estimate: Trajectory, truth: Trajectory) -> np.ndarray:
    a, b = (se3.inverse(t.T[0]) @ t.T for t in (estimate, truth))
    return np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)


def halved(image: Image) -> Image:
    """Return the image of a camera with half of the exposure."""
    pixels = cv2.imdecode(np.frombuffer(image.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    return replace(image, jpeg=cv2.imencode(".jpg", pixels // 2, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


def test_a_camera_without_images_for_a_second(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = [p for p in images(scene / "log.mcap") if p.camera == "lower" or not 7 <= p.pair < 17]
    log = save(tmp_path / "log.mcap", taken)
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert result.count("unpaired_lower") == 10 and result.count("pairs") == PAIRS - 10
    assert states(tmp_path / "out.mcap") == [("tracking", 0), ("degraded", 0), ("tracking", 0)]
    truth = read_tum(scene / "truth.txt")
    seen = [*range(7), *range(17, PAIRS)]
    assert errors_m(read_tum(tmp_path / "est"), Trajectory(truth.stamps_ns[seen], truth.T[seen])).max() < 0.02


def test_two_seconds_of_darkness(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = images(scene / "log.mcap")
    before, last_pair = [p for p in taken if p.pair < 12], [p for p in taken if p.pair == 11]
    dark_images = [dark(p.later(1 + k)) for k in range(DARK_PAIRS) for p in last_pair]
    later = [p.later(DARK_PAIRS) for p in taken if p.pair >= 12]
    log = save(tmp_path / "log.mcap", [*before, *dark_images, *later])
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert result.code == 0 and len(rows(tmp_path / "est")) == PAIRS + DARK_PAIRS
    found = states(tmp_path / "out.mcap")
    assert ("lost", 0) in found and found[-1] == ("tracking", 0)
    sigma_m = np.array([np.sqrt(np.trace(r.covariance[:3, :3])) for r in recorded(tmp_path / "out.mcap")])
    assert (np.diff(sigma_m[13 : 11 + DARK_PAIRS]) > 0).all() and sigma_m[10 + DARK_PAIRS] > 10 * sigma_m[11]
    assert sigma_m[-1] < 0.02
    estimate, truth = read_tum(tmp_path / "est"), read_tum(scene / "truth.txt")
    seen = [*range(12), *range(12 + DARK_PAIRS, PAIRS + DARK_PAIRS)]
    assert errors_m(Trajectory(estimate.stamps_ns[seen], estimate.T[seen]), truth).max() < 0.02


@pytest.mark.parametrize("cameras", [("lower", "upper"), ("upper",)])
def test_images_without_texture_at_the_start(
    omnid: Command, tmp_path: Path, scene: Path, cameras: tuple[str, ...]
) -> None:
    """They differ by a grey level, so that no camera counts as frozen."""

    def blank(image: Image) -> Image:
        grey = np.full(read_rig(scene / "rig.toml").lower.camera.size[::-1], 8 * image.pair, np.uint8)
        return replace(image, jpeg=cv2.imencode(".jpg", grey)[1].tobytes())

    taken = images(scene / "log.mcap")
    log = save(tmp_path / "log.mcap", [blank(p) if p.pair < 5 and p.camera in cameras else p for p in taken])
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    assert result.code == 0 and "Traceback" not in result.err
    found = [state for state, _ in states(tmp_path / "out.mcap")]
    assert found[0] == "lost" and found[-1] == "tracking"


def test_another_scene_after_the_darkness(omnid: Command, tmp_path: Path, scene: Path, elsewhere: Path) -> None:
    before, after = images(scene / "log.mcap"), images(elsewhere / "log.mcap")
    dark_images = [dark(p.later(1 + k)) for k in range(DARK_PAIRS) for p in before[:2]]
    log = save(tmp_path / "log.mcap", [*before[:2], *dark_images, *(p.later(1 + DARK_PAIRS) for p in after)])
    omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    found = states(tmp_path / "out.mcap")
    assert found[-1] == ("tracking", 1)
    last = recorded(tmp_path / "out.mcap")[-1]
    assert np.sqrt(np.trace(last.covariance[:3, :3])) > 0.5  # the gap stays in the covariance


def test_cameras_that_are_exchanged_on_the_way(omnid: Command, tmp_path: Path, scene: Path) -> None:
    """The lower camera alone tracks on, 0.2 m too high, and stereo of exchanged images finds points by chance."""
    other = {"lower": "upper", "upper": "lower"}
    taken = [p if p.pair < 6 else replace(p, camera=other[p.camera]) for p in images(scene / "log.mcap")]
    log = save(tmp_path / "log.mcap", taken)
    result = omnid.replay(log, "--record", tmp_path / "out.mcap", rig=scene / "rig.toml")
    assert "after the pose was lost, the images match better the other way round" in result.err
    found = states(tmp_path / "out.mcap")
    assert found[0] == ("tracking", 0) and "lost" in dict(found)
    assert "tracking" not in dict(found[1:])


def test_a_camera_whose_images_are_half_as_bright(omnid: Command, tmp_path: Path, scene: Path) -> None:
    taken = [halved(p) if p.camera == "lower" else p for p in images(scene / "log.mcap")]
    log = save(tmp_path / "log.mcap", taken)
    omnid.replay(log, "--record", tmp_path / "out.mcap", "--tum", tmp_path / "est", rig=scene / "rig.toml")
    assert states(tmp_path / "out.mcap") == [("tracking", 0)]
    assert errors_m(read_tum(tmp_path / "est"), read_tum(scene / "truth.txt")).max() < 0.02


def test_the_first_motion_decides_on_depths_that_repeat(tmp_path: Path) -> None:
    """At 512 px most landmarks of the first pair are three courses off, and the wall is six times as far away."""
    run, pairs = build("brick_corridor", 3, 512, 60), 4
    write_log(tmp_path, run.rig, run.poses[:pairs], run.scene, seed=3)
    found = replay(tmp_path / "log.mcap", tmp_path / "rig.toml")
    moved_m = np.linalg.norm(found.T_odom_rig[:, :3, 3] - found.T_odom_rig[0, :3, 3], axis=1)
    assert moved_m == pytest.approx(np.linalg.norm(run.poses[:pairs, :3, 3] - run.poses[0, :3, 3], axis=1), abs=0.01)


SEED, SIZE = 3, 512
LINE_TIME_US = 40.0  # 20 ms for 512 rows


def driven(folder: Path, readout: Readout) -> Metrics:
    """Render the first metre of two_walls, and return the errors of a replay in which no pair was lost."""
    run = build("two_walls", SEED, SIZE, 99)
    write_log(
        folder,
        run.rig,
        run.poses[:PAIRS],
        run.scene,
        sensor=run.sensor,
        seed=SEED,
        supersample=2,
        readout=readout,
    )
    times = ShutterTimes(0.0, 1e-6 * readout.line_time_us[0])
    result = omnid.replay(folder / "log.mcap", replace(read_rig(folder / "rig.toml"), times=times))
    states = result.counters.states
    assert result.counters.pairs == PAIRS and states[TrackingState.LOST] == 0
    assert states[TrackingState.TRACKING] > 0.9 * PAIRS
    return evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))


@pytest.mark.slow
def test_the_motion_between_the_exposures_is_corrected(tmp_path: Path) -> None:
    speed = 1.4  # 0.7 m/s
    skew = driven(tmp_path / "skew", readout=Readout(speed, (15.0, 15.0)))
    assert abs(skew.length_error_ratio) < 0.0015 and skew.ate_rmse_m < 0.002
    rolling = Readout(speed, line_time_us=(LINE_TIME_US, LINE_TIME_US))
    known = driven(tmp_path / "known", readout=rolling)
    assert abs(known.length_error_ratio) < 0.0015 and known.ate_rmse_m < 0.002
