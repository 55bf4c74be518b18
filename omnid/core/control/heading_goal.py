"""What a controller that steers to a heading by itself is told, in its own count of headings."""

from __future__ import annotations

import math

from omnid.core.control.heading_controller import Setpoint, wrap_angle

LEAD_RAD = 0.5  # how far a turn at a rate may be ahead of a base that does not follow


class HeadingGoal:
    """Headings in odom for a controller that counts its own from somewhere, and drifts.

    A yaw rate becomes a heading that turns at that rate, so that the base follows it without drift.
    """

    def __init__(self) -> None:
        self._turning_rad: float | None = None  # odom; where a turn at a rate has led to
        self._offset_rad = 0.0  # from headings in odom to those of the controller
        self._counted_rad = 0.0  # the controller's heading as it said last

    def heard(self, counted_rad: float, heading_rad: float | None) -> None:
        """Takes the controller's heading, NaN where it knows none, and the one in odom now, None where that is unsure.
        """
        if not math.isfinite(counted_rad):
            return
        self._counted_rad = counted_rad
        if heading_rad is not None and math.isfinite(heading_rad):
            self._offset_rad = wrap_angle(counted_rad - heading_rad)

    def towards(self, setpoint: Setpoint, heading_rad: float, turn_rad: float) -> float:
        """The controller's heading that a setpoint leads to from heading_rad in odom, turn_rad further than before.

        Numbers that are not finite lead nowhere: it stays.
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
        """The controller's heading to keep while the base slows down: the one it has."""
        self._turning_rad = None
        return self._counted_rad
