"""Limits of speed, yaw rate and acceleration, applied to every motion before it is sent, whatever its source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

from omnid.core.control.heading_controller import LONGEST_TICK_S, Twist, clamp

STOP: Final = Twist()


@dataclass(frozen=True, slots=True)
class VelocityLimits:
    """Limits of the commands to the wheels, in magnitude; the deceleration holds for stops as well."""

    velocity_mps: Annotated[float, Meta(ge=0.001, le=10), "highest speed, m/s"] = 0.6
    acceleration_mps2: Annotated[float, Meta(ge=0.001, le=100), "highest acceleration, m/s^2"] = 0.6
    deceleration_mps2: Annotated[float, Meta(ge=0.001, le=100), "highest deceleration, at stops as well, m/s^2"] = 1.5
    yaw_rate_radps: Annotated[float, Meta(ge=0.001, le=20), "highest yaw rate, rad/s"] = 1.2
    yaw_acceleration_radps2: Annotated[float, Meta(ge=0.001, le=200), "highest yaw acceleration, rad/s^2"] = 4.0

    def step(self, wanted: Twist, last: Twist, dt_s: float) -> Twist:
        """Return the motion to send dt_s after `last`; a wanted motion that is not finite is a stop.

        A last motion that is not finite counts as the stop, one beyond the limits as at the limits. A time that is not
        finite or negative counts as 0, one longer than LONGEST_TICK_S as that: a late tick allows no larger step.
        """
        # 1. Bring the inputs into their limits.
        wanted, last = (motion if _finite(motion) else STOP for motion in (wanted, last))
        dt_s = min(max(dt_s, 0.0), LONGEST_TICK_S) if math.isfinite(dt_s) else 0.0
        top_mps, top_radps = self.velocity_mps, self.yaw_rate_radps
        velocity_mps, yaw_rate_radps = clamp(last.velocity_mps, top_mps), clamp(last.yaw_rate_radps, top_radps)
        # 2. Approach what is wanted with the accelerations allowed.
        reach_radps = self.yaw_acceleration_radps2 * dt_s
        return Twist(
            self._velocity(velocity_mps, clamp(wanted.velocity_mps, top_mps), dt_s),
            yaw_rate_radps + clamp(clamp(wanted.yaw_rate_radps, top_radps) - yaw_rate_radps, reach_radps),
        )

    def _velocity(self, last_mps: float, wanted_mps: float, dt_s: float) -> float:
        """Return the speed on the way to the wanted one: down to 0 where its sign changes, then up in the time left."""
        speed_mps, goal_mps = math.copysign(1.0, last_mps) * last_mps, math.copysign(1.0, last_mps) * wanted_mps
        if goal_mps >= speed_mps:
            speed_mps = min(goal_mps, speed_mps + self.acceleration_mps2 * dt_s)
        else:
            # The time that is left once the base is at rest; it has an effect only where the goal is of the other sign.
            left_s = max(0.0, dt_s - speed_mps / self.deceleration_mps2)
            slowed_mps = max(goal_mps, 0.0, speed_mps - self.deceleration_mps2 * dt_s)
            speed_mps = max(min(goal_mps, slowed_mps), slowed_mps - self.acceleration_mps2 * left_s)
        return math.copysign(1.0, last_mps) * speed_mps


def _finite(motion: Twist) -> bool:
    return math.isfinite(motion.velocity_mps) and math.isfinite(motion.yaw_rate_radps)
