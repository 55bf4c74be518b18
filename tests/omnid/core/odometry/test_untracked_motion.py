"""While poses are refused: the sigma of the speed, and the motion at a refused speed as a runner-up."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.runner_up_motions import CLEAR_STEPS, doubt_after
from omnid.core.odometry.untracked_motion import UNTRACKED_SPEED_SIGMA, UntrackedMotion

FIX = se3.exp([1.0, 2.0, 0.0, 0.0, 0.0, 0.5])


def at(*twist: float) -> np.ndarray:
    """Return the pose after a twist (6,) from the last accepted one."""
    return np.asarray(FIX @ se3.exp(twist))


def test_the_fastest_refused_pose_is_the_sigma_of_the_speed() -> None:
    motion = UntrackedMotion(FIX)
    assert motion.sigma.tolist() == 6 * [UNTRACKED_SPEED_SIGMA]
    motion = motion.refused(at(0.9, 0, 0, 0, 0, 0), 0.1).refused(at(1.2, 0, 0, 0, 0, 0), 0.2)
    assert motion.sigma == pytest.approx([9.0, 9.0, 9.0, *3 * [UNTRACKED_SPEED_SIGMA]])


def test_a_pose_found_again_may_have_gone_on_at_the_refused_speed() -> None:
    """After 0.5 s at 8 m/s the vehicle is 4 m ahead of the fix, to the right of a pose that is turned to the left."""
    found = PoseEstimate(at(0, 0, 0, 0, 0, np.pi / 2), np.zeros((6, 6)), 100, 100, 100)
    assert UntrackedMotion(FIX).in_doubt(found, 0.5) is found
    doubtful = UntrackedMotion(FIX).refused(at(0.8, 0, 0, 0, 0, 0), 0.1).in_doubt(found, 0.5)
    assert doubtful.runner_up == pytest.approx([0.0, -4.0, 0.0, 0.0, 0.0, 0.0])


def test_no_later_step_decides_on_it() -> None:
    found = PoseEstimate(FIX, np.zeros((6, 6)), 100, 100, 100)
    moved = UntrackedMotion(FIX).refused(at(0.8, 0, 0, 0, 0, 0), 0.1).in_doubt(found, 0.5)
    doubt = doubt_after(None, FIX, moved, 0.1)
    for _ in range(2 * CLEAR_STEPS):
        doubt = doubt_after(doubt, FIX, found, 0.1)
    assert doubt is not None and not doubt.is_open
    assert np.sqrt(np.trace(doubt.covariance(FIX)[:3, :3])) == pytest.approx(4.0, rel=0.01)
