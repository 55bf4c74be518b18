"""The goal for a motor controller that holds a heading by itself, in its own count of headings."""

from __future__ import annotations

import math
from typing import Final

from omnid.core.control.heading_controller import HeadingLimits, clamp, wrap_angle
from omnid.core.control.velocity_limits import VelocityLimits

# Between the heading that the motor controller reported and its turn to the next goal; by trial with simulated
# controllers.
REACTION_S: Final = 0.15
# Times the yaw rate's limit, reported: the goal is the present heading until it is slower.
OVERSPEED: Final = 1.1


def longest_lead_rad(heading: HeadingLimits, velocity: VelocityLimits) -> float:
    """Return the limit of the lead of the goal over the heading.

    It is the angle that the base turns at the highest rate within the reaction time, and then until it has braked. A
    motor controller turns the faster, the larger the lead is, by a gain that is not known here.
    """
    rate_radps = min(heading.yaw_rate_radps, velocity.yaw_rate_radps)
    acceleration_radps2 = min(heading.yaw_acceleration_radps2, velocity.yaw_acceleration_radps2)
    return min(math.pi / 2, rate_radps * REACTION_S + rate_radps**2 / (2 * acceleration_radps2))


class HeadingGoal:
    """Integrate yaw rates, which are within the limits, to headings in the motor controller's own count.

    The count starts anywhere, and drifts. No heading in odom is converted to it: the pose decides about the yaw rate
    only, so that a pose that jumps does not move the goal by more than the limits allow in a tick.
    """

    def __init__(self, heading: HeadingLimits, velocity: VelocityLimits) -> None:
        self._longest_rad = longest_lead_rad(heading, velocity)
        self._highest_radps = OVERSPEED * min(heading.yaw_rate_radps, velocity.yaw_rate_radps)
        self._goal_rad: float | None = None  # goal of the last tick, while the base turns or drives
        self._counted_rad = self._rate_radps = 0.0  # values of the last report

    def update(self, counted_rad: float, rate_radps: float) -> None:
        """Take the heading and the yaw rate that the motor controller reported; NaN where it knows none."""
        if math.isfinite(counted_rad):
            self._counted_rad = counted_rad
        self._rate_radps = rate_radps if math.isfinite(rate_radps) else 0.0

    def towards(self, turn_rad: float, error_rad: float | None = None) -> float:
        """Return the goal after a turn since the last call; the present heading where a number is not finite.

        error_rad: angle to the wanted heading, which the goal does not pass; None where a yaw rate is wanted.
        """
        if not math.isfinite(turn_rad) or (error_rad is not None and not math.isfinite(error_rad)):
            return self.stay()
        before_rad = self._counted_rad if self._goal_rad is None else self._goal_rad
        lead_rad = clamp(wrap_angle(before_rad + turn_rad - self._counted_rad), self._longest_rad)
        if error_rad is not None and abs(error_rad) < self._longest_rad:
            lead_rad = min(max(lead_rad, min(error_rad, 0.0)), max(error_rad, 0.0))
        if abs(self._rate_radps) > self._highest_radps and self._rate_radps * lead_rad > 0:
            lead_rad = 0.0
        self._goal_rad = wrap_angle(self._counted_rad + lead_rad)
        return self._goal_rad

    def stay(self) -> float:
        """Return the present heading as the goal, while the base slows down."""
        self._goal_rad = None
        return self._counted_rad
