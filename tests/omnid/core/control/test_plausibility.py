"""Reasons to drive slowly, and how slowly; the parts have tests of their own."""

from __future__ import annotations

import pytest

from omnid.core.control.heading_controller import Twist
from omnid.core.control.motion_monitor import Motion, MotionSettings
from omnid.core.control.trust import POSE_DEGRADED, Plausibility, TrustSettings
from omnid.core.control.velocity_limits import VelocityLimits

LIMITS = VelocityLimits(velocity_mps=0.8, yaw_rate_radps=1.5)


@pytest.mark.parametrize("side", [1, -1])
def test_a_degraded_pose_slows_down_to_its_share_of_the_limits(side: int) -> None:
    plausibility = Plausibility(TrustSettings(degraded_speed=0.4), MotionSettings())
    fast, slow = Twist(side * 0.7, -side * 1.4), Twist(side * 0.3, -side * 0.5)
    for state, expected in (("tracking", fast), ("degraded", Twist(side * 0.32, -side * 0.6)), ("tracking", fast)):
        plausibility.add_pose(1, state, Motion(0.0, 0.0), 0)
        assert plausibility.slowed_by == (POSE_DEGRADED if state == "degraded" else "")
        slowed = plausibility.slowed(fast, LIMITS)
        assert (slowed.velocity_mps, slowed.yaw_rate_radps) == pytest.approx(
            (expected.velocity_mps, expected.yaw_rate_radps)
        )
        assert plausibility.slowed(slow, LIMITS) == slow, "within the share already"
