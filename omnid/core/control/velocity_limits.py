"""The last word on a motion before it becomes bytes: no output breaks a limit, whatever comes in."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from omnid.core.control.heading_controller import LONGEST_TICK_S, Twist
from omnid.errors import OmnidError
from omnid.settings import knob

STOP = Twist()


@dataclass(frozen=True, slots=True)
class VelocityLimits:
    """What the wheels may be told, in magnitude; stops are slowed down within the deceleration as well."""

    velocity_mps: float = knob(0.6, "highest speed, m/s", low=0.001, high=10)
    acceleration_mps2: float = knob(0.6, "highest acceleration, m/s^2", low=0.001, high=100)
    deceleration_mps2: float = knob(1.5, "highest deceleration, at stops as well, m/s^2", low=0.001, high=100)
    yaw_rate_radps: float = knob(1.2, "highest yaw rate, rad/s", low=0.001, high=20)
    yaw_acceleration_radps2: float = knob(4.0, "highest yaw acceleration, rad/s^2", low=0.001, high=200)

    def __post_init__(self) -> None:
        """OmnidError unless each number is finite and above 0."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise OmnidError(f"command limits: {field.name} is {value}; give a finite number above 0")

    def step(self, wanted: Twist, last: Twist, dt_s: float) -> Twist:
        """What is sent dt_s after `last` was; a wanted drive that is not finite is a stop.

        A last drive that is not finite counts as standing, one beyond the limits as at them. A time that is not finite
        or runs backwards counts as none, one that is longer than LONGEST_TICK_S as that: a late tick earns no jump.
        """
        wanted, last = (drive if _finite(drive) else STOP for drive in (wanted, last))
        dt_s = min(max(dt_s, 0.0), LONGEST_TICK_S) if math.isfinite(dt_s) else 0.0
        top_mps, top_radps = self.velocity_mps, self.yaw_rate_radps
        velocity_mps, yaw_rate_radps = _clamp(last.velocity_mps, top_mps), _clamp(last.yaw_rate_radps, top_radps)
        reach_radps = self.yaw_acceleration_radps2 * dt_s
        return Twist(
            self._velocity(velocity_mps, _clamp(wanted.velocity_mps, top_mps), dt_s),
            yaw_rate_radps + _clamp(_clamp(wanted.yaw_rate_radps, top_radps) - yaw_rate_radps, reach_radps),
        )

    def _velocity(self, last_mps: float, wanted_mps: float, dt_s: float) -> float:
        """Towards the wanted speed: first down to a stand where it changes sides, then up for what time is left."""
        speed_mps, goal_mps = math.copysign(1.0, last_mps) * last_mps, math.copysign(1.0, last_mps) * wanted_mps
        if goal_mps >= speed_mps:
            speed_mps = min(goal_mps, speed_mps + self.acceleration_mps2 * dt_s)
        else:
            floor_mps = max(goal_mps, 0.0)
            left_s = max(0.0, dt_s - (speed_mps - floor_mps) / self.deceleration_mps2)
            slowed_mps = max(floor_mps, speed_mps - self.deceleration_mps2 * dt_s)
            speed_mps = max(min(goal_mps, slowed_mps), slowed_mps - self.acceleration_mps2 * left_s)
        return math.copysign(1.0, last_mps) * speed_mps


def _finite(drive: Twist) -> bool:
    return math.isfinite(drive.velocity_mps) and math.isfinite(drive.yaw_rate_radps)


def _clamp(value: float, magnitude: float) -> float:
    return max(-magnitude, min(magnitude, value))
