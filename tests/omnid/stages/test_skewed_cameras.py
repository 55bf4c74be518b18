"""Cameras that are not synchronised: motion is no wrong rig and hides none; both stamps in the public API."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import omnid
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from drivers.motion import WheelSample
from omnid.config import Config, load_config
from omnid.core.rig.rig_health import RigContradictedError
from omnid.messages import FramePair
from omnid.runs.replay import ReplayOptions, run_log
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry
from omnid.tracking_state import TrackingState
from tests.simulation import MountedSensor, Sensor, build, corridor, render_grey, write_log
from tests.simulation.logs import Readout
from tests.simulation.paths import planar_poses
from tests.simulation.rigs import make_rig, with_upper_rotated


@pytest.fixture(scope="module")
def skewed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Rig]:
    """Write a log of fast driving whose upper images are 25 ms later; return it and its rig."""
    folder = tmp_path_factory.mktemp("skewed")
    run = build("two_walls", seed=32, size=256, pairs=14)
    write_log(
        folder,
        run.rig,
        run.poses,
        run.scene,
        sensor=run.sensor,
        seed=32,
        readout=Readout(speed=2.0, skew_ms=(25.0, 25.0)),
    )
    return folder / "log.mcap", read_rig(folder / "rig.toml")


@pytest.mark.parametrize(("turn_deg", "warned"), [(0.0, False), (0.7, True)])
def test_a_drifted_rig_is_reported_and_motion_is_not(skewed: tuple[Path, Rig], turn_deg: float, warned: bool) -> None:
    log, rig = skewed
    warnings = omnid.replay(log, with_upper_rotated(rig, (0.0, turn_deg, 0.0))).warnings
    assert any("do not quite fit the rig" in text for text in warnings) == warned, warnings


def test_exchanged_cameras_are_refused_and_nothing_is_written(skewed: tuple[Path, Rig], tmp_path: Path) -> None:
    log, rig = skewed
    options = ReplayOptions(
        rig=rig, topics=(rig.topics[1], rig.topics[0]), tum=tmp_path / "a.tum", record=tmp_path / "a.mcap"
    )
    with pytest.raises(RigContradictedError, match="other way round"):
        run_log(log, Config(), options)
    assert not list(tmp_path.iterdir())


def test_images_with_both_stamps_give_the_poses_of_a_replay(skewed: tuple[Path, Rig]) -> None:
    log, rig = skewed
    expected = omnid.replay(log, rig)
    found = list(LogReader(log, *rig.topics).frames())
    frames = {name: [frame for frame in found if frame.camera == name] for name in ("lower", "upper")}
    odometry, blind = omnid.Odometry(rig), omnid.Odometry(rig)
    for number, (lower, upper) in enumerate(zip(frames["lower"], frames["upper"], strict=True)):
        images = gray(lower), gray(upper)
        update = odometry.process(lower.stamp_ns, *images, upper_stamp_ns=upper.stamp_ns)
        np.testing.assert_array_equal(update.T_odom_rig, expected.T_odom_rig[number])
        at_once = blind.process(lower.stamp_ns, *images)
    assert not np.array_equal(at_once.T_odom_rig, update.T_odom_rig)
    with pytest.raises(omnid.OmnidError, match="less than 1 s from stamp_ns"):
        odometry.process(lower.stamp_ns + 1, *images, upper_stamp_ns=lower.stamp_ns // 1000)
    with pytest.raises(omnid.OmnidError, match="upper_stamp_ns: expected an integer"):
        odometry.process(lower.stamp_ns + 1, *images, upper_stamp_ns=0.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("dark_pairs", [1, 3])
def test_darkness_after_the_first_pair_costs_nothing(dark_pairs: int) -> None:
    """The map is made again with the first step only where no pair between was refused: wheels carry the pose there."""
    rig, scene, period_ns, skew_s, speed_mps = make_rig(size=256), corridor(3), 100_000_000, 0.02, 0.5
    config = load_config(None, ["rig.check=off"])
    front_end = FrontEnd(geometry(rig, config.panorama), config)
    rng = np.random.default_rng(0)
    mounted = rig.lower, rig.upper
    sensors = [MountedSensor.of(Sensor(), one.visible, one.camera.size) for one in mounted]
    for number in range(dark_pairs + 3):
        stamp_ns = 10**9 + number * period_ns
        along_m = speed_mps * (number * period_ns * 1e-9 + np.array([0.0, skew_s]))
        poses = planar_poses(np.column_stack([along_m, np.zeros(2)]), np.zeros(2))
        images = [
            sensor.expose(render_grey(scene, one, pose), rng)
            for sensor, one, pose in zip(sensors, mounted, poses, strict=True)
        ]
        if 1 <= number <= dark_pairs:
            images = [np.zeros_like(image) for image in images]
        wheels = tuple(WheelSample(stamp_ns + k * period_ns // 5, speed_mps, 0.0) for k in range(-9, 2))
        update = front_end.process(FramePair(number, stamp_ns, *images, skew_s, wheels))
        front_end.odometry.complete()
    assert update.state is TrackingState.TRACKING and update.reset_counter == 0
    assert abs(update.T_odom_rig[0, 3] - along_m[0]) < 3e-3
    assert np.sqrt(update.covariance[0, 0]) < 0.01
