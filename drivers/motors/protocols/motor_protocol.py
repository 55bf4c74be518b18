"""Interface of driver and protocol: frames and transactions; kinematics and wiring of a base with two driven sides.

A protocol does no I/O. It consists of transactions: generators that yield the bytes to write (none: only wait), are
sent the next complete frame each time, and return the result. The driver runs a transaction up to a deadline;
the transaction itself waits without a limit:

    def connect(self, watchdog_ms):
        frame = yield b"^RWD %d\\r" % watchdog_ms
        while frame != b"+":
            frame = yield b""
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Annotated, Protocol, TypeAlias, TypeVar

from msgspec import Meta

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand

T = TypeVar("T")
_MAX_LINE = 256  # bytes


class NoReplyError(DriverError):
    """No reply before the timeout, from a port that is still there."""


Transaction: TypeAlias = Generator[bytes, bytes, T]


class Framer(Protocol):
    """Splits a byte stream, received in pieces of any size, into frames; needs bounded memory."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the frames that end in data."""

    def reset(self) -> None:
        """Discard the incomplete frame."""


class MotorProtocol(Protocol):
    """Commands <-> bytes of one kind of controller; one object serves one connection."""

    baud: int  # default of the controller

    @property
    def framer(self) -> Callable[[], Framer]:
        """What makes a new framer for the controller's replies."""

    def connect(self, watchdog_ms: int) -> Transaction[float]:
        """Set up the controller and its watchdog, and return the watchdog's time in force [ms].

        Raises DriverError where the controller does not take the settings.
        """

    def drive(self, command: VelocityCommand) -> Transaction[MotorStatus]:
        """Send a command and return the status; raise DriverError for a command that the controller rejects."""


def require_watchdog(requested_ms: int, in_force_ms: float) -> None:
    """Raise DriverError unless the requested watchdog time is in force."""
    if round(in_force_ms) != requested_ms:
        raise DriverError(
            f"watchdog of {requested_ms} ms requested, {in_force_ms:g} ms in force; set another motor.watchdog_ms"
        )


class TextFramer:
    """Splits text into lines that end in CR or LF; returns them without the end, and drops empty and too long ones."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that end in data."""
        *lines, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        self._rest = rest[: _MAX_LINE + 1]  # which is too long once it ends, if this cuts it
        return [line for line in lines if 0 < len(line) <= _MAX_LINE]

    def reset(self) -> None:
        """Discard the incomplete line."""
        self._rest = b""


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
