"""Commands to a wheeled base and its status: the interface of all motor drivers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Drive at a velocity towards a heading; velocity 0 with yaw rate 0 is a stop, whatever the heading."""

    stamp_ns: int  # time of the decision; not sent to the controller
    velocity_mps: float  # forward
    heading_rad: float  # of the base in odom, counter-clockwise, for controllers that steer to a heading themselves
    yaw_rate_radps: float  # counter-clockwise, for controllers without a heading input


@dataclass(frozen=True, slots=True)
class MotorStatus:
    """State of the controller when it received a command."""

    velocity_mps: float  # forward
    heading_rad: float  # counter-clockwise, 0 at the connection; NaN if unknown
    yaw_rate_radps: float  # counter-clockwise
    watchdog_expired: bool  # the controller's watchdog had stopped the wheels before this command
    fault: int  # 0 if none; else the controller's own number
    battery_v: float  # NaN if unknown
    bumper: bool = False  # a bumper that is wired to the controller is pressed
    cliff: bool = False  # a cliff sensor that is wired to it sees no floor


class MotorDriver(Protocol):
    """Driver of a base; calls block for a bounded time, and it has no threads."""

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Send one command and return the controller's reply; raise DriverError without a reply."""

    def close(self) -> None:
        """Stop the wheels, then release the device; never raises."""


def stop_command(stamp_ns: int) -> VelocityCommand:
    """Return the command that stops the wheels."""
    return VelocityCommand(stamp_ns, velocity_mps=0.0, heading_rad=0.0, yaw_rate_radps=0.0)


def is_stop(command: VelocityCommand) -> bool:
    """True if the command stops the wheels."""
    return command.velocity_mps == 0.0 and command.yaw_rate_radps == 0.0
