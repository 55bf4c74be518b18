"""What a wheeled base is told and what it answers; every motor driver speaks in these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Drive at a speed towards a heading; velocity 0 with yaw rate 0 is the stop, whatever the heading."""

    stamp_ns: int
    velocity_mps: float  # forward
    heading_rad: float  # of the base in odom, counter-clockwise, for controllers that steer to a heading themselves
    yaw_rate_radps: float  # counter-clockwise, for controllers without a heading input


@dataclass(frozen=True, slots=True)
class MotorStatus:
    """The controller's state when a command reached it."""

    velocity_mps: float
    heading_rad: float  # since the controller was connected; NaN if unknown
    yaw_rate_radps: float
    watchdog_expired: bool  # it had stopped the wheels by itself before this command
    fault: int  # 0 is none; else the controller's own number
    battery_v: float  # NaN if unknown


class MotorDriver(Protocol):
    """A base that can be driven; calls block for a bounded time; no threads inside."""

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Hands one command over and gives the answer; DriverError where none came."""

    def close(self) -> None:
        """Stops the wheels, then releases the device; never raises."""


def stop_command(stamp_ns: int) -> VelocityCommand:
    """The command to stand still."""
    return VelocityCommand(stamp_ns, velocity_mps=0.0, heading_rad=0.0, yaw_rate_radps=0.0)


def is_stop(command: VelocityCommand) -> bool:
    """Whether the command is the stop."""
    return command.velocity_mps == 0.0 and command.yaw_rate_radps == 0.0
