"""One camera whose images hold both views: two mirrors side by side or one around the other, divided by masks."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.boards.board import Board
from calib.models.camera import Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig, write_rig
from drivers.cameras.log_camera import LogCamera, LogClock, LogImages
from drivers.cameras.shared_camera import SharedCamera
from drivers.frame import Camera
from drivers.logs.log_reader import LogReader
from omnid.config import load_config
from omnid.report.report_data import collect_report_data
from omnid.runs.live import LiveRun
from omnid.runs.live_robot import ConnectedRobot, LiveCamera
from tests.replay.command import Command
from tests.simulation import corridor, make_rig, one_image, paths
from tests.simulation.boards import board_poses_around_rig
from tests.simulation.one_image import TOPIC

PAIRS, SIZE, SEED, BOARD = 14, 384, 4, Board(5, 4, 0.07)
EVERY_PIXEL = np.stack(np.meshgrid(np.arange(640.0), np.arange(640.0)), axis=-1).reshape(-1, 2)


def beside(mounted: MountedCamera, shift_px: float) -> MountedCamera:
    """Return the camera as the part of an image of twice the width that begins at a column."""
    camera, mask = mounted.camera, mounted.mask
    assert isinstance(camera, UnifiedCamera) and mask is not None
    moved = replace(camera, center=(camera.center[0] + shift_px, camera.center[1]), size=(2 * SIZE, SIZE))
    return replace(mounted, camera=moved, mask=Mask((mask.center[0] + shift_px, mask.center[1]), 0.0, mask.outer_px))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a log with one topic, whose images show the lower mirror on the left and the upper one on the right."""
    folder, apart = tmp_path_factory.mktemp("one"), make_rig(size=SIZE, misaligned_deg=(0.5, -0.4, 0.6))
    rig = Rig(beside(apart.lower, 0), beside(apart.upper, SIZE), topics=(TOPIC, TOPIC))
    one_image.write_log(folder, rig, paths.spline_path(SEED, PAIRS, 0.05), corridor(SEED), SEED)
    write_rig(folder / "apart.toml", apart)
    return folder


def test_one_topic_gives_both_cameras(recording: Path, tmp_path: Path, omnid: Command) -> None:
    found = tmp_path / "out.txt"
    done = omnid("replay", recording / "log.mcap", "--rig", recording / "rig.toml", "--quiet", "--tum", found)
    assert done.code == 0 and f"{PAIRS} of {PAIRS} pairs" in done.out and "tracking 100.0%" in done.out, done
    errors = json.loads(omnid("eval", found, recording / "truth.txt", "--json").out)
    assert abs(errors["length_error_ratio"]) < 0.002 and errors["ate_rmse_m"] < 0.003, errors


@pytest.mark.slow
def test_two_mirrors_on_one_axis_are_calibrated_by_boards_and_replayed(tmp_path: Path, omnid: Command) -> None:
    """The lower view is a disc, the upper one the ring around it; each image shows the board twice."""
    truth, log, out = one_image.coaxial_rig(640), tmp_path / "log.mcap", tmp_path / "out.txt"
    one_image.write_log(tmp_path, truth, paths.spline_path(SEED, PAIRS, 0.05), corridor(SEED), SEED)
    poses = board_poses_around_rig(truth, BOARD, 8, distance_m=(0.45, 1.0), elevation_deg=(70.0, 125.0))
    one_image.write_boards(tmp_path / "boards", truth, BOARD, poses, noise=1.0)
    lower, upper = one_image.areas(truth)
    words = ("--corners", "5x4", "--square-mm", 70, "--lower-area", lower, "--upper-area", upper, "--model", "omni")
    done = omnid("calibrate", "rig", tmp_path / "boards", *words, "-o", tmp_path / "found.toml")
    assert done.code == 0 and ", 8 pairs" in done.out, done
    assert "view: mirror, as one view lies around the other" in done.err
    found = read_rig(tmp_path / "found.toml")
    assert found.baseline_m == pytest.approx(truth.baseline_m, abs=1e-3)
    for side, true in ((found.lower, truth.lower), (found.upper, truth.upper)):
        assert side.camera.center == pytest.approx(true.camera.center, abs=0.2) and side.mask is not None
        wrong = side.mask.contains(EVERY_PIXEL) != true.visible.contains(EVERY_PIXEL)
        assert wrong.mean() < 0.02, "the masks are those of the views"
    lengths = []
    for rig in (tmp_path / "rig.toml", tmp_path / "found.toml"):
        done = omnid("replay", log, "--rig", rig, "--lower", TOPIC, "--upper", TOPIC, "--quiet", "--tum", out)
        assert done.code == 0 and "tracking 100.0%" in done.out, done
        lengths.append(json.loads(omnid("eval", out, tmp_path / "truth.txt", "--json").out)["length_error_ratio"])
    assert abs(lengths[0]) < 0.002 and abs(lengths[1] - lengths[0]) < 0.002, lengths


def test_one_device_of_both_views_needs_masks_and_is_opened_once(
    recording: Path, tmp_path: Path, omnid: Command
) -> None:
    device = tmp_path / "video9"
    words = ("run", "--lower", device, "--upper", device, "--rig")
    assert "[lower.mask] and [upper.mask] must tell" in omnid.refused(*words, without_upper_mask(recording, tmp_path))
    assert f"camera {device}" in omnid.refused(*words, recording / "rig.toml"), "it comes as far as the device"
    code, _, err = omnid("record", tmp_path / "rec", *words[1:5])
    assert code == 2 and f"{device} is both cameras" in err and f"camera {device}" in err.splitlines()[-1]
    board = ("--corners", "6x7", "--square-mm", 30)
    assert "expected two devices" in omnid.refused("calibrate", "live", tmp_path / "live", *board, *words[1:5])


def without_upper_mask(recording: Path, folder: Path) -> Path:
    text = (recording / "rig.toml").read_text()
    (folder / "rig.toml").write_text(text[: text.index("[upper.mask]")])
    return folder / "rig.toml"


def test_masks_must_tell_which_part_is_whose(recording: Path, tmp_path: Path, omnid: Command) -> None:
    rig = without_upper_mask(recording, tmp_path)
    log = recording / "log.mcap"
    assert "[upper.mask] must tell which part" in omnid.refused("replay", log, "--rig", rig, "--quiet")
    assert "no lower camera" in omnid.refused("replay", log, "--rig", recording / "apart.toml", "--quiet")


def test_a_live_run_takes_both_views_from_one_stream(recording: Path, tmp_path: Path) -> None:
    """Run the daemon on a log in place of the device: each view has a thread, both have the same stamps."""
    images = LogImages.load(recording / "log.mcap", TOPIC, TOPIC)
    opened = list[SharedCamera]()

    def open_view(camera: Camera) -> LiveCamera:
        if camera == "lower":
            opened.append(SharedCamera(LogCamera(images, "lower", LogClock(), pace=0.25, once=True)))
        return opened[-1].lower if camera == "lower" else opened[-1].upper

    config = load_config(None, [f"record.folder={tmp_path}", "record.enabled=true", "bus.listen=[]"])
    run = LiveRun(config, ConnectedRobot(open_view), lambda *_: None, read_rig(recording / "rig.toml"))
    assert run.run() == 0 and len(opened) == 1
    (log,) = tmp_path.glob("*.mcap")
    stamps: dict[str, set[int]] = {"lower": set(), "upper": set()}
    with closing(LogReader(log)) as reader:
        for frame in reader.frames():
            stamps[frame.camera].add(frame.stamp_ns)
    assert len(stamps["lower"]) == PAIRS and stamps["upper"] <= stamps["lower"]
    poses = collect_report_data(log, keep_poses=True).poses
    moved_m = np.linalg.norm(poses.trajectory.T[-1, :3, 3] - poses.trajectory.T[0, :3, 3])
    assert poses.poses >= 2 and 0.04 < moved_m < 0.05 * PAIRS
