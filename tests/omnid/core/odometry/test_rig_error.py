"""The errors of a rig in the covariance of the pose: one error along the whole path, not one a step."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.fit.rig_uncertainty import motion_errors
from calib.rig import Rig, RigCovariance
from omnid.core.odometry.rig_error import RigError
from tests.simulation.rigs import make_rig

BASELINE_M, SCALE = 0.2, 0.01


def rig(sigma_m: float) -> Rig:
    covariance = RigCovariance(("baseline",), np.array([sigma_m]), np.eye(1))
    return replace(make_rig(baseline_m=BASELINE_M), covariance=covariance)


def poses(*xy: tuple[float, float]) -> list[se3.Array]:
    return [se3.transform(se3.rotation_exp([0.0, 0.0, 0.3 * k]), [x, y, 0.0]) for k, (x, y) in enumerate(xy)]


def test_a_scale_is_one_error_along_the_path() -> None:
    """G = p: the error of the position is the scale times the position, whatever the way, its turns and steps."""
    error = RigError(motion_errors(rig(SCALE * BASELINE_M)))
    for T in poses((0.1, 0), (1, 0), (2, 1), (2, 2), (1, 3)):
        covariance = error.at(T, 2.0)
        in_odom = T[:3, :3] @ covariance[:3, :3] @ T[:3, :3].T
        p = T[:3, 3]
        assert in_odom == pytest.approx(SCALE**2 * np.outer(p, p), abs=0.03 * SCALE**2 * float(p @ p))


def test_a_way_back_takes_off_what_the_way_there_has_added() -> None:
    error = RigError(motion_errors(replace(make_rig(), covariance=None)))
    there = math.sqrt(np.trace(error.at(se3.transform(np.eye(3), [3.0, 0.0, 0.0]), 2.0)[:3, :3]))
    back = math.sqrt(np.trace(error.at(np.eye(4), 2.0)[:3, :3]))
    # A file without a covariance may be wrong by 0.2 % of scale and 0.05 degree.
    assert there > 0.002 * 3.0 and back < 1e-3 * there


def test_a_turn_of_a_camera_makes_poses_worse_the_farther_what_they_see() -> None:
    turned = replace(make_rig(), covariance=RigCovariance(("r_x",), np.array([math.radians(0.05)]), np.eye(1)))
    near, far = (
        RigError(motion_errors(turned)).at(se3.transform(np.eye(3), [1.0, 0.0, 0.0]), distance_m)
        for distance_m in (2.0, 8.0)
    )
    assert far[2, 2] > 4 * near[2, 2] > 0
