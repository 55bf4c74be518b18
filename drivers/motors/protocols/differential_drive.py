"""Kinematics and wiring of a base with two driven sides: forward velocity and yaw rate <-> channel speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from drivers.errors import DriverError
from drivers.motor import VelocityCommand


@dataclass(frozen=True, slots=True)
class DifferentialDrive:
    """Geometry and wiring. A controller's channels are its motors in its own order and sense of rotation."""

    track_m: Annotated[
        float,
        Meta(ge=0.01, le=10),
        "distance of the left and the right wheels, m; where they skid: the one that makes measured turns right",
    ] = 0.3
    wheel_radius_m: Annotated[float, Meta(ge=0.001, le=5), "radius of the wheels, m"] = 0.05
    max_wheel_mps: Annotated[float, Meta(ge=0.001, le=20), "highest speed of a wheel, m/s"] = 1.0
    gear: Annotated[float, Meta(ge=0.001, le=10_000), "turns of the motor per turn of the wheel"] = 1.0
    pole_pairs: Annotated[int, Meta(ge=1, le=100), "vesc: pole pairs of the motor"] = 7
    reverse_left: Annotated[bool, "the left motor turns the other way round"] = False
    reverse_right: Annotated[bool, "the right motor turns the other way round"] = False
    swapped: Annotated[bool, "the motor controller's first motor is the right one"] = False
    can_id: Annotated[int, Meta(ge=0, le=253), "vesc: id of the second motor's controller"] = 1

    @property
    def turns_per_m(self) -> float:
        """Turns of a motor per metre of its wheel."""
        return self.gear / (math.tau * self.wheel_radius_m)

    @property
    def rpm_per_mps(self) -> float:
        """Turns of a motor per minute at 1 m/s of its wheel."""
        return 60 * self.turns_per_m

    def limited(self, command: VelocityCommand, max_wheel_mps: float = math.inf) -> tuple[float, float]:
        """Return velocity [m/s] and yaw rate [rad/s], scaled by one factor where a wheel would be too fast.

        max_wheel_mps: limit of the protocol, besides the one of this drive. Raises DriverError for numbers that are
        not finite.
        """
        if not all(map(math.isfinite, (command.velocity_mps, command.yaw_rate_radps, command.heading_rad))):
            raise DriverError(f"{command}: only finite numbers can be sent, send a stop instead")
        fastest_mps = abs(command.velocity_mps) + abs(command.yaw_rate_radps) * self.track_m / 2
        scale = min(1.0, min(self.max_wheel_mps, max_wheel_mps) / fastest_mps) if fastest_mps > 0.0 else 1.0
        return command.velocity_mps * scale, command.yaw_rate_radps * scale

    def channels(self, command: VelocityCommand, max_wheel_mps: float = math.inf) -> tuple[float, float]:
        """Return the speeds of the two channels [m/s], limited as by `limited`, which keeps the curvature."""
        velocity_mps, yaw_rate_radps = self.limited(command, max_wheel_mps)
        half_mps = yaw_rate_radps * self.track_m / 2
        return self.to_channels(velocity_mps - half_mps, velocity_mps + half_mps)

    def motion(self, first_mps: float, second_mps: float) -> tuple[float, float]:
        """Return velocity [m/s] and yaw rate [rad/s] of the base from the measured speeds of the channels."""
        left_mps, right_mps = self.to_sides(first_mps, second_mps)
        return (left_mps + right_mps) / 2, (right_mps - left_mps) / self.track_m

    def to_sides(self, first: float, second: float) -> tuple[float, float]:
        """Return the values of the left and the right wheel, forward positive, from those of the channels."""
        left, right = (second, first) if self.swapped else (first, second)
        return -left if self.reverse_left else left, -right if self.reverse_right else right

    def to_channels(self, left: float, right: float) -> tuple[float, float]:
        """Return the values of the channels from those of the wheels: the inverse of `to_sides`."""
        left, right = -left if self.reverse_left else left, -right if self.reverse_right else right
        return (right, left) if self.swapped else (left, right)
