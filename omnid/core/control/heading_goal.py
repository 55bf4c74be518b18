"""The goal for a motor controller that holds a heading by itself, in its own count of headings."""

from __future__ import annotations

import math
from typing import Final

from omnid.core.control.heading_controller import Setpoint, wrap_angle

LEAD_RAD: Final = 0.5  # limit of the lead of the goal over the heading, while the base turns at a rate


class HeadingGoal:
    """Convert headings in odom for a motor controller whose own headings start anywhere, and drift.

    A yaw rate becomes a heading that turns at that rate, so that the base follows it without drift.
    """

    def __init__(self) -> None:
        self._turning_rad: float | None = None  # in odom: the goal of a turn at a rate
        self._offset_rad = 0.0  # from headings in odom to those of the motor controller
        self._counted_rad = 0.0  # the motor controller's heading, as last reported

    def update(self, counted_rad: float, heading_rad: float | None) -> None:
        """Take the heading that the motor controller reported and the one in odom at that time.

        counted_rad: NaN where it knows none. heading_rad: None where the pose cannot be trusted.
        """
        if not math.isfinite(counted_rad):
            return
        self._counted_rad = counted_rad
        if heading_rad is not None and math.isfinite(heading_rad):
            self._offset_rad = wrap_angle(counted_rad - heading_rad)

    def towards(self, setpoint: Setpoint, heading_rad: float, turn_rad: float) -> float:
        """Return the goal for a setpoint, in the motor controller's count.

        heading_rad: measured, in odom. turn_rad: of a turn at a rate, since the last call. The present heading is the
        goal where a number is not finite.
        """
        if not all(map(math.isfinite, (setpoint.heading_rad or 0.0, heading_rad, turn_rad))):
            return self.stay()
        if setpoint.heading_rad is not None:
            self._turning_rad = None
            return wrap_angle(setpoint.heading_rad + self._offset_rad)
        before_rad = heading_rad if self._turning_rad is None else self._turning_rad
        ahead_rad = wrap_angle(before_rad + turn_rad - heading_rad)
        self._turning_rad = heading_rad + max(-LEAD_RAD, min(LEAD_RAD, ahead_rad))
        return wrap_angle(self._turning_rad + self._offset_rad)

    def stay(self) -> float:
        """Return the present heading as the goal, while the base slows down."""
        self._turning_rad = None
        return self._counted_rad
