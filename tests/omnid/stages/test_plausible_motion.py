"""Rendered drives as the controller sees them: the motion of a right rig is plausible, a wrong one's is not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.frame import gray
from drivers.logs.mcap_reader import LogReader
from omnid import Odometry
from omnid.core.control.heading_controller import Twist
from omnid.core.control.motion_monitor import NOT_COMMANDED, NOT_SEEN, Motion, MotionSettings
from omnid.core.control.plausibility import MotorReport, Plausibility
from omnid.core.control.trust import TrustSettings
from omnid.formats.tum import read_tum
from omnid.stages.lockstep_drive import controller_pose
from tests.conftest import PAIRS

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
        yield judged.slowed_by, judged._monitor.reason
        for tick in range(TICKS):
            now_ns = stamp_ns + tick * PERIOD_NS // TICKS
            judged.add_command(now_ns, command)
            judged.add_report(now_ns, MotorReport(Motion(command.velocity_mps, command.yaw_rate_radps)))


def test_the_motion_of_a_right_rig_is_plausible(scene: Path) -> None:
    found = list(stops(read_rig(scene / "rig.toml"), image_pairs(scene / "log.mcap"), true_motions(scene)))
    assert found == [("", "")] * STRAIGHT_PAIRS


@pytest.mark.parametrize(("factor", "expected"), [(3.0, NOT_COMMANDED), (0.25, NOT_SEEN)])
def test_a_rig_of_another_size_stops_the_base(scene: Path, factor: float, expected: str) -> None:
    """All epipolar lines are right with it; only the wheels can tell."""
    rig = read_rig(scene / "rig.toml")
    T_rig_upper = se3.inverse(rig.upper.T_cam_rig)
    T_rig_upper[:3, 3] = rig.lower.viewpoint + factor * (rig.upper.viewpoint - rig.lower.viewpoint)
    wrong = replace(rig, upper=replace(rig.upper, T_cam_rig=se3.inverse(T_rig_upper)))
    found = list(stops(wrong, image_pairs(scene / "log.mcap"), true_motions(scene)))
    assert found[-1][1] == expected and any(slow and not reason for slow, reason in found)


def test_images_that_stand_stop_the_base(scene: Path) -> None:
    """The same scene with other noise: no comparison of pixels finds it."""
    rng = np.random.default_rng(3)
    lower, upper = image_pairs(scene / "log.mcap")[0]

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)

    standing = [(noisy(lower), noisy(upper)) for _ in range(STRAIGHT_PAIRS)]
    found = list(stops(read_rig(scene / "rig.toml"), standing, [Twist(0.5)] * STRAIGHT_PAIRS))
    assert found[-1][1] == NOT_SEEN
    at_rest = list(stops(read_rig(scene / "rig.toml"), standing, [Twist()] * STRAIGHT_PAIRS))
    assert at_rest == [("", "")] * STRAIGHT_PAIRS, "a base at rest before a motionless scene"
