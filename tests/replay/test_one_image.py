"""One camera whose images hold both views: two mirrors side by side in one image, divided by the rig's masks."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

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
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.simulation.rendering.sensor import MountedSensor, Sensor
from tests.drivers.logs.mcap_logs import COMPRESSED, Entry, compressed, write_log
from tests.replay.command import Command
from tests.simulation import corridor, make_rig, paths, tum

PAIRS, SIZE, SEED, START_NS, PERIOD_NS, TOPIC = 14, 384, 4, 10**18, 10**8, "/camera/image/compressed"


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
    poses, scene, rng = paths.spline_path(SEED, PAIRS, 0.05), corridor(SEED), np.random.default_rng(SEED)
    stamps = START_NS + PERIOD_NS * np.arange(PAIRS, dtype=np.int64)
    sensors = [MountedSensor.of(Sensor(), m.visible, m.camera.size) for m in (apart.lower, apart.upper)]
    entries = []
    for stamp, T in zip(stamps.tolist(), poses, strict=True):
        views = [
            sensor.expose(render_grey(scene, m, T, 2), rng)
            for sensor, m in zip(sensors, (apart.lower, apart.upper), strict=True)
        ]
        entries.append(Entry(TOPIC, COMPRESSED, compressed(stamp, sensors[0].jpeg(np.hstack(views))), stamp))
    write_log(folder / "log.mcap", entries)
    (folder / "truth.txt").write_text(tum(stamps, poses))
    write_rig(folder / "rig.toml", Rig(beside(apart.lower, 0), beside(apart.upper, SIZE), topics=(TOPIC, TOPIC)))
    write_rig(folder / "apart.toml", apart)
    return folder


def test_one_topic_gives_both_cameras(recording: Path, tmp_path: Path, omnid: Command) -> None:
    found = tmp_path / "out.txt"
    done = omnid("replay", recording / "log.mcap", "--rig", recording / "rig.toml", "--quiet", "--tum", found)
    assert done.code == 0 and f"{PAIRS} of {PAIRS} pairs" in done.out and "tracking 100.0%" in done.out, done
    errors = json.loads(omnid("eval", found, recording / "truth.txt", "--json").out)
    assert abs(errors["length_error_ratio"]) < 0.002 and errors["ate_rmse_m"] < 0.003, errors


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
