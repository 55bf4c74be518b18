"""What the controller gets of a pose; rendered drives with a plausible motion or not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib import se3
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from omnid import Odometry
from omnid.core.control.heading_controller import Twist
from omnid.core.control.motion_monitor import (
    NOT_COMMANDED,
    NOT_SEEN,
    Motion,
    MotionSettings,
    Plausibility,
    TrustSettings,
)
from omnid.formats.tum import read_tum
from omnid.messages import OdometryUpdate
from omnid.sinks.drive import controller_pose
from omnid.tracking_state import TrackingState
from tests.conftest import PAIRS


def odometry(
    at_s: float, state: TrackingState = TrackingState.TRACKING, *, heading_rad: float = 0.0, rate_radps: float = 0.0
) -> OdometryUpdate:
    T_odom_rig = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading_rad]))
    velocity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, rate_radps])
    depth: Any = None
    return OdometryUpdate(
        0, 10**12 + round(at_s * 1e9), T_odom_rig, np.eye(6), velocity, 1e-4 * np.eye(6), state, 0, 99, 99, depth
    )


@pytest.mark.parametrize("odd", [{"heading_rad": math.nan}, {"rate_radps": math.nan}])
def test_a_pose_that_is_not_finite_is_lost(odd: dict[str, float]) -> None:
    assert controller_pose(odometry(0.0), np.eye(4)).state == TrackingState.TRACKING
    assert controller_pose(odometry(0.0, **odd), np.eye(4)).state == TrackingState.LOST


TICKS = 2  # between two pairs
PERIOD_NS = 100_000_000
START_NS = 10**12
STRAIGHT_PAIRS = PAIRS - 2  # before the turn at the end


def image_pairs(log: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    reader = LogReader(log)
    images = {"lower": [], "upper": []}
    for frame in reader.frames():
        images[frame.camera].append(gray(frame))
    reader.close()
    return list(zip(images["lower"], images["upper"], strict=True))[:STRAIGHT_PAIRS]


def true_motions(folder: Path) -> list[Twist]:
    """Return the motion from each pose to the next."""
    T = read_tum(folder / "truth.txt").T
    steps = [se3.log(se3.inverse(a) @ b) / (PERIOD_NS * 1e-9) for a, b in pairwise(T)]
    return [Twist(float(step[0]), float(step[5])) for step in steps]


def stops(rig: Rig, images: list[tuple[np.ndarray, np.ndarray]], commands: list[Twist]) -> Iterator[tuple[str, str]]:
    """Yield the reasons to drive slowly and to stop after each pair of images."""
    odometry, judged = Odometry(rig), Plausibility(TrustSettings(), MotionSettings())
    for number, (pair, command) in enumerate(zip(images, commands, strict=False)):
        stamp_ns = START_NS + number * PERIOD_NS
        pose = controller_pose(odometry.process(stamp_ns, *pair), np.eye(4))
        judged.add_pose(stamp_ns, pose.state, pose.motion, pose.resets)
        yield judged.slowed_by, judged.reason
        for tick in range(TICKS):
            now_ns = stamp_ns + tick * PERIOD_NS // TICKS
            judged.add_command(now_ns, command)
            judged.add_report(now_ns, Motion(command.velocity_mps, command.yaw_rate_radps), 0, math.nan)


def test_the_motion_of_a_right_rig_is_plausible(scene: Path) -> None:
    found = list(stops(read_rig(scene / "rig.toml"), image_pairs(scene / "log.mcap"), true_motions(scene)))
    assert found == [("", "")] * STRAIGHT_PAIRS


@pytest.mark.hazard("H38")
@pytest.mark.parametrize(("factor", "expected"), [(3.0, NOT_COMMANDED), (0.25, NOT_SEEN)])
def test_a_rig_of_another_size_stops_the_base(scene: Path, factor: float, expected: str) -> None:
    """All epipolar lines are right with it; only the wheels can tell."""
    rig = read_rig(scene / "rig.toml")
    T_rig_upper = se3.inverse(rig.upper.T_cam_rig)
    T_rig_upper[:3, 3] = rig.lower.viewpoint + factor * (rig.upper.viewpoint - rig.lower.viewpoint)
    wrong = replace(rig, upper=replace(rig.upper, T_cam_rig=se3.inverse(T_rig_upper)))
    found = list(stops(wrong, image_pairs(scene / "log.mcap"), true_motions(scene)))
    assert found[-1][1] == expected and any(slow and not reason for slow, reason in found)
