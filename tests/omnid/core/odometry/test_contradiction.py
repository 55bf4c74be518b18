"""Covariance of a pose that wheels and gyro contradict, on drives that are computed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.control.motion_monitor import AGREE, GYRO_DIFFERS, IMAGES_OR_WHEELS, WHEELS_DIFFER, Difference, Witness
from omnid.core.odometry.motion_agreement import contradiction_after
from tests.omnid.core.odometry.test_motion_agreement import BEGINS_S, Errors, driven

Array = NDArray[np.float64]


def pose(x_m: float, yaw_rad: float = 0.0) -> Array:
    return se3.exp(np.array([x_m, 0.0, 0.0, 0.0, 0.0, 0.0])) @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, yaw_rad]))


@pytest.mark.parametrize("scale", [0.6, 0.85, 1.2])
def test_it_is_about_the_whole_difference_of_the_drive(scale: float) -> None:
    """Of 9 m straight on: images of a rig whose size is wrong, or of a person who walks along."""
    found = None
    for at_s, witness in driven(Errors(images_scale=scale), 20.0, turns=False):
        way_m = 0.5 * max(0.0, at_s - BEGINS_S - 0.4)
        found = contradiction_after(found, witness, pose(scale * way_m), at_s)
    assert found is not None
    assert found.faults[0] == pytest.approx((1 - scale) * way_m, rel=0.1)
    sigmas_m = np.sqrt(np.diag(found.covariance())[:3])
    assert sigmas_m == pytest.approx([abs(found.faults[0]), 0.0, 0.0], abs=1e-9)


def test_a_fault_stays_in_a_later_pose_and_turns_with_it() -> None:
    """After a quarter turn to the left, what was ahead is to the right."""
    witness = Witness(IMAGES_OR_WHEELS, "", True, Difference(0.4, 6.0))
    found = contradiction_after(None, witness, pose(1.0), 1.0)
    later = contradiction_after(found, AGREE, pose(1.0, np.pi / 2), 9.0)
    assert later is not None
    assert later.faults[:3] == pytest.approx([0.0, -0.4, 0.0], abs=1e-9)
    assert np.diag(later.covariance())[1] == pytest.approx(0.4**2)


def test_a_doubt_is_over_with_its_reason() -> None:
    """Until then the pose may be off by it, beside what a fault has left."""
    doubt, fault = (Witness(IMAGES_OR_WHEELS, "", is_fault, Difference(0.2, 6.0)) for is_fault in (False, True))
    found = contradiction_after(None, doubt, pose(0.0), 1.0)
    assert found is not None and found.covariance()[0, 0] == pytest.approx(0.2**2)
    found = contradiction_after(found, AGREE, pose(0.0), 2.0)
    assert found is not None and not found.covariance().any()
    found = contradiction_after(found, fault, pose(0.0), 3.0)
    found = contradiction_after(found, doubt, pose(0.0), 6.0)
    assert found is not None and found.covariance()[0, 0] == pytest.approx((0.2 + 0.2 * 3 / 6) ** 2)


@pytest.mark.parametrize("reason", [WHEELS_DIFFER, GYRO_DIFFERS])
def test_accounts_that_two_others_contradict_say_nothing_about_the_pose(reason: str) -> None:
    witness = Witness(reason, "", True, Difference(0.4, 6.0), Difference(0.1, 6.0))
    assert contradiction_after(None, witness, pose(0.0), 0.0) is None
