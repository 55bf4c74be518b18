"""The law of motion: from a setpoint of speed and heading to a speed and a yaw rate within all limits, one step a tick.

Whatever its input, a step exceeds no limit of speed, yaw rate and acceleration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

LONGEST_TICK_S: Final = 0.2  # a late tick does not allow a larger step; by trial on development seeds
GAIN_HZ: Final = 1.5  # yaw rate per heading error
# Far above the noise of a heading: a larger change is a jump of odometry, and closer to half a turn than this the base
# keeps the side to which it turns.
JUMP_RAD: Final = 0.3
# Share of a deceleration that is planned for braking; the rest is left for the lag of the base.
BRAKING_SHARE: Final = 0.8
# Between the heading that a motor controller reported and its turn to the next goal; by trial with simulated ones.
REACTION_S: Final = 0.15


@dataclass(frozen=True, slots=True)
class Setpoint:
    """A wanted speed, and a wanted heading in odom or, where that is None, a wanted yaw rate."""

    velocity_mps: float = 0.0
    heading_rad: float | None = None
    yaw_rate_radps: float = 0.0


@dataclass(frozen=True, slots=True)
class Twist:
    """A motion of the base: forward speed and yaw rate, counter-clockwise."""

    velocity_mps: float = 0.0
    yaw_rate_radps: float = 0.0

    @property
    def is_finite(self) -> bool:
        """True if both are numbers."""
        return math.isfinite(self.velocity_mps) and math.isfinite(self.yaw_rate_radps)


STOP: Final = Twist()


def wrap_angle(angle_rad: float) -> float:
    """Return the same direction within -pi .. pi; NaN for a number that is not finite."""
    return math.remainder(angle_rad, math.tau) if math.isfinite(angle_rad) else math.nan


def clamp(value: float, magnitude: float) -> float:
    """Return the value, limited to a magnitude."""
    return max(-magnitude, min(magnitude, value))


@dataclass(frozen=True, slots=True)
class VelocityLimits:
    """Limits of the commands to the wheels, in magnitude; the deceleration holds for stops as well."""

    velocity_mps: Annotated[float, Meta(ge=0.001, le=10), "highest speed, m/s"] = 0.5
    acceleration_mps2: Annotated[float, Meta(ge=0.001, le=100), "highest acceleration, m/s^2"] = 0.5
    deceleration_mps2: Annotated[float, Meta(ge=0.001, le=100), "highest deceleration, at stops as well, m/s^2"] = 1.5
    yaw_rate_radps: Annotated[float, Meta(ge=0.001, le=20), "highest yaw rate, rad/s"] = 1.0
    yaw_acceleration_radps2: Annotated[float, Meta(ge=0.001, le=200), "highest yaw acceleration, rad/s^2"] = 3.0

    def step(self, wanted: Twist, last: Twist, dt_s: float) -> Twist:
        """Return the motion to send dt_s after `last`; a wanted motion that is not finite is a stop.

        A last motion that is not finite counts as the stop, one beyond the limits as at the limits. A time that is not
        finite or negative counts as 0, one longer than LONGEST_TICK_S as that: a late tick allows no larger step.
        """
        wanted, last = (self.within(motion) for motion in (wanted, last))
        dt_s = min(max(dt_s, 0.0), LONGEST_TICK_S) if math.isfinite(dt_s) else 0.0
        turn_radps, reach_radps = wanted.yaw_rate_radps - last.yaw_rate_radps, self.yaw_acceleration_radps2 * dt_s
        # The speed in the direction of the last one: down to 0 where the sign changes, then up in the time left.
        sign = math.copysign(1.0, last.velocity_mps)
        speed_mps, goal_mps = sign * last.velocity_mps, sign * wanted.velocity_mps
        if goal_mps >= speed_mps:
            speed_mps = min(goal_mps, speed_mps + self.acceleration_mps2 * dt_s)
        else:
            left_s = max(0.0, dt_s - speed_mps / self.deceleration_mps2)
            slowed_mps = max(goal_mps, 0.0, speed_mps - self.deceleration_mps2 * dt_s)
            speed_mps = max(min(goal_mps, slowed_mps), slowed_mps - self.acceleration_mps2 * left_s)
        return Twist(sign * speed_mps, last.yaw_rate_radps + clamp(turn_radps, reach_radps))

    def within(self, motion: Twist) -> Twist:
        """Return a motion within the speeds allowed; the stop for one that is not finite."""
        if not motion.is_finite:
            return STOP
        return Twist(clamp(motion.velocity_mps, self.velocity_mps), clamp(motion.yaw_rate_radps, self.yaw_rate_radps))


def towards(setpoint: Setpoint, heading_rad: float, last: Twist, limits: VelocityLimits) -> Twist:
    """Return the wanted motion; heading_rad is measured, in odom. A stop where a number is not finite.

    A heading is held by a proportional yaw rate. Near the goal it is at most sqrt(2 a e) with the yaw acceleration a
    and the heading error e, from which the base can still brake. last: the present motion.
    """
    wanted = Twist(setpoint.velocity_mps, setpoint.yaw_rate_radps)
    if not (math.isfinite(heading_rad) and wanted.is_finite):
        return STOP
    if setpoint.heading_rad is None:
        return limits.within(wanted)
    error_rad = wrap_angle(wrap_angle(setpoint.heading_rad) - heading_rad)
    size_rad, side = abs(error_rad), error_rad
    if size_rad > math.pi - JUMP_RAD and last.yaw_rate_radps != 0.0:
        side = last.yaw_rate_radps
    braking_radps = math.sqrt(2 * BRAKING_SHARE * limits.yaw_acceleration_radps2 * size_rad)
    return limits.within(Twist(setpoint.velocity_mps, math.copysign(min(GAIN_HZ * size_rad, braking_radps), side)))


class HeadingGoal:
    """The goal for a motor controller that holds a heading by itself, in its own count of headings.

    Yaw rates, which are within the limits, are integrated. The count starts anywhere, and drifts. No heading in odom is
    converted to it: the pose decides about the yaw rate only, so that a pose that jumps does not move the goal by more
    than the limits allow in a tick.
    """

    def __init__(self, limits: VelocityLimits) -> None:
        # The lead over the heading is at most the angle that the base turns at the highest rate within the reaction
        # time, and then until it has braked: a motor controller turns the faster, the larger the lead is.
        rate_radps = limits.yaw_rate_radps
        turned_rad = rate_radps * REACTION_S + rate_radps**2 / (2 * limits.yaw_acceleration_radps2)
        self._longest_rad = min(math.pi / 2, turned_rad)
        self._goal_rad: float | None = None  # goal of the last tick, while the base turns or drives
        self._counted_rad = 0.0  # in the last report

    def update(self, counted_rad: float) -> None:
        """Take the heading that the motor controller reported; NaN where it knows none."""
        if math.isfinite(counted_rad):
            self._counted_rad = counted_rad

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
        self._goal_rad = wrap_angle(self._counted_rad + lead_rad)
        return self._goal_rad

    def stay(self) -> float:
        """Return the present heading as the goal, while the base slows down."""
        self._goal_rad = None
        return self._counted_rad
