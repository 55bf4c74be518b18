"""The wheels of a base with two driven sides: forward speed and yaw rate <-> wheel speeds <-> controllers' units."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.errors import DriverError
from drivers.motor import VelocityCommand

_SIZES = ("track_m", "wheel_radius_m", "max_wheel_mps", "gear", "ticks_per_turn", "pole_pairs")


@dataclass(frozen=True, slots=True)
class DifferentialDrive:
    """Geometry and wiring. A controller's channels are its motors in its own order and sense of rotation.

    The track of a base that skids (four wheels, tracks) is the one that makes its measured turns right.
    """

    track_m: float = 0.3  # between the left and the right wheels
    wheel_radius_m: float = 0.05
    max_wheel_mps: float = 1.0  # no wheel is told to roll faster
    gear: float = 1.0  # turns of the motor for one of the wheel
    ticks_per_turn: float = 1000.0  # of the encoder, for one turn of the motor
    pole_pairs: int = 7  # of the motor
    reverse_left: bool = False
    reverse_right: bool = False
    swapped: bool = False  # channel 1 is the right wheel
    can_id: int = 1  # of the controller of channel 2 where each motor has its own

    def __post_init__(self) -> None:
        """DriverError for a size that is not finite and above 0."""
        for name in _SIZES:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise DriverError(f"motor drive: {name} is {value}; give a finite number above 0")

    @property
    def turns_per_m(self) -> float:
        """Turns of a motor for a metre of its wheel."""
        return self.gear / (math.tau * self.wheel_radius_m)

    def limited(self, command: VelocityCommand, max_wheel_mps: float = math.inf) -> tuple[float, float]:
        """The command's speed [m/s] and yaw rate [rad/s], both scaled alike where a wheel would be too fast.

        DriverError for numbers that are not finite.
        """
        _require_finite(command)
        fastest_mps = abs(command.velocity_mps) + abs(command.yaw_rate_radps) * self.track_m / 2
        scale = min(1.0, min(self.max_wheel_mps, max_wheel_mps) / fastest_mps) if fastest_mps > 0.0 else 1.0
        return command.velocity_mps * scale, command.yaw_rate_radps * scale

    def channels(self, command: VelocityCommand, max_wheel_mps: float = math.inf) -> tuple[float, float]:
        """The command as the speeds of the channels [m/s], limited with the curvature kept."""
        velocity_mps, yaw_rate_radps = self.limited(command, max_wheel_mps)
        half_mps = yaw_rate_radps * self.track_m / 2
        return self._wired(velocity_mps - half_mps, velocity_mps + half_mps)

    def motion(self, first_mps: float, second_mps: float) -> tuple[float, float]:
        """Speed [m/s] and yaw rate [rad/s] of the base from the measured speeds of the channels."""
        left_mps, right_mps = self.sides(first_mps, second_mps)
        return (left_mps + right_mps) / 2, (right_mps - left_mps) / self.track_m

    def sides(self, first: float, second: float) -> tuple[float, float]:
        """What belongs to the left and to the right wheel, forward positive, of what the channels say."""
        left, right = (second, first) if self.swapped else (first, second)
        return -left if self.reverse_left else left, -right if self.reverse_right else right

    def _wired(self, left: float, right: float) -> tuple[float, float]:
        """The inverse of `sides`."""
        left, right = -left if self.reverse_left else left, -right if self.reverse_right else right
        return (right, left) if self.swapped else (left, right)


def _require_finite(command: VelocityCommand) -> None:
    named = (("velocity", command.velocity_mps), ("yaw rate", command.yaw_rate_radps), ("heading", command.heading_rad))
    for name, value in named:
        if not math.isfinite(value):
            raise DriverError(f"motor {name} is {value}; only finite numbers can be sent, send a stop instead")
