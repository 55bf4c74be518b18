"""Heading controller: from a setpoint of speed and heading to a bounded speed and yaw rate, one step a tick."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

LONGEST_TICK_S: Final = 0.2  # a late tick does not allow a larger step; by trial on development seeds
HALF_TURN_RAD: Final = 0.2  # closer to half a turn than this, noise would change the side to turn to
# Share of a deceleration that is planned for braking; the rest is left for the lag of the base.
BRAKING_SHARE: Final = 0.8


@dataclass(frozen=True, slots=True)
class HeadingLimits:
    """Limits of the heading controller, in magnitude, and its gain."""

    velocity_mps: Annotated[float, Meta(ge=0.001, le=10), "highest speed, m/s"] = 0.5
    acceleration_mps2: Annotated[float, Meta(ge=0.001, le=100), "highest acceleration, m/s^2"] = 0.5
    yaw_rate_radps: Annotated[float, Meta(ge=0.001, le=20), "highest yaw rate, rad/s"] = 1.0
    yaw_acceleration_radps2: float = 3.0  # highest yaw acceleration, rad/s^2
    gain_hz: float = 1.5  # yaw rate per heading error, 1/s


@dataclass(frozen=True, slots=True)
class Setpoint:
    """A wanted speed, and a wanted heading in odom or, where that is None, a wanted yaw rate."""

    velocity_mps: float
    heading_rad: float | None = None
    yaw_rate_radps: float = 0.0


@dataclass(frozen=True, slots=True)
class Twist:
    """A motion of the base: forward speed and yaw rate, counter-clockwise."""

    velocity_mps: float = 0.0
    yaw_rate_radps: float = 0.0


def wrap_angle(angle_rad: float) -> float:
    """Return the same direction within -pi .. pi; NaN for a number that is not finite."""
    return math.remainder(angle_rad, math.tau) if math.isfinite(angle_rad) else math.nan


@dataclass(frozen=True, slots=True)
class HeadingController:
    """A proportional heading controller whose output never exceeds its limits, whatever its input.

    Rate and acceleration are bounded; near the goal the rate is at most sqrt(2 a e) with the acceleration a and the
    heading error e, from which the base can still brake.
    """

    limits: HeadingLimits = HeadingLimits()

    def step(self, setpoint: Setpoint, heading_rad: float, dt_s: float, previous: Twist) -> Twist:
        """Return the motion dt_s after `previous`; heading_rad is measured, in odom.

        Where setpoint or heading are not finite, the base stops as fast as the limits allow. Where the time or the
        previous motion are not finite, it stops at once: there is no speed to slow down from.
        """
        # 1. Bring the inputs into their limits.
        if not all(map(math.isfinite, (dt_s, previous.velocity_mps, previous.yaw_rate_radps))):
            return Twist()
        limits = self.limits
        dt_s = min(max(dt_s, 0.0), LONGEST_TICK_S)
        velocity_mps = clamp(previous.velocity_mps, limits.velocity_mps)
        yaw_rate_radps = clamp(previous.yaw_rate_radps, limits.yaw_rate_radps)
        # 2. The motion that turns to the heading.
        wanted = self._wanted(setpoint, heading_rad, yaw_rate_radps)
        # 3. Approach it with the accelerations allowed.
        return Twist(
            _towards(velocity_mps, wanted.velocity_mps, limits.acceleration_mps2 * dt_s),
            _towards(yaw_rate_radps, wanted.yaw_rate_radps, limits.yaw_acceleration_radps2 * dt_s),
        )

    def _wanted(self, setpoint: Setpoint, heading_rad: float, yaw_rate_radps: float) -> Twist:
        """Return the motion without limits of acceleration; a stop where a number is not finite."""
        goal_rad = 0.0 if setpoint.heading_rad is None else setpoint.heading_rad
        numbers = (setpoint.velocity_mps, setpoint.yaw_rate_radps, goal_rad, heading_rad)
        if not all(map(math.isfinite, numbers)):
            return Twist()
        rate_radps = setpoint.yaw_rate_radps
        if setpoint.heading_rad is not None:
            rate_radps = self._rate(wrap_angle(wrap_angle(goal_rad) - wrap_angle(heading_rad)), yaw_rate_radps)
        limits = self.limits
        return Twist(clamp(setpoint.velocity_mps, limits.velocity_mps), clamp(rate_radps, limits.yaw_rate_radps))

    def _rate(self, error_rad: float, yaw_rate_radps: float) -> float:
        """Return the yaw rate for a heading error; near half a turn the base keeps the side to which it turns."""
        size_rad = abs(error_rad)
        braking_radps = math.sqrt(2 * BRAKING_SHARE * self.limits.yaw_acceleration_radps2 * size_rad)
        side = error_rad
        if size_rad > math.pi - HALF_TURN_RAD and yaw_rate_radps != 0.0:
            side = yaw_rate_radps
        return math.copysign(min(self.limits.gain_hz * size_rad, braking_radps), side)


def clamp(value: float, magnitude: float) -> float:
    """Return the value, limited to a magnitude."""
    return max(-magnitude, min(magnitude, value))


def _towards(value: float, goal: float, reach: float) -> float:
    """Return the value, moved towards the goal by at most reach."""
    return value + clamp(goal - value, reach)
