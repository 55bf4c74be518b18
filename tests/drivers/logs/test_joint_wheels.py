"""Velocities of the joints of two wheels as the rates of a base."""

from __future__ import annotations

import math

import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.joint_wheels import JointWheels

WHEELS = JointWheels("left", "right", 0.1, 0.4)


def test_rates_follow_from_radius_and_track() -> None:
    assert WHEELS.rates({"left": 2.0, "right": 4.0, "arm": 9.0}) == pytest.approx((0.3, 0.5))


def test_messages_of_other_joints_are_none() -> None:
    assert WHEELS.rates({"arm": 1.0}) is None


@pytest.mark.parametrize(
    "velocities", [{"left": 1.0}, {"left": 1.0, "right": math.nan}, {"left": math.inf, "right": 1.0}]
)
def test_half_of_the_wheels_is_an_error(velocities: dict[str, float]) -> None:
    with pytest.raises(FrameDecodeError, match="no velocity of left or of right"):
        WHEELS.rates(velocities)
