"""Settings of the motor controller and of the base; imports nothing that opens a device."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated

from msgspec import Meta

from drivers.motors.protocols.differential_drive import DifferentialDrive


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Geometry and wiring of a base with two driven sides."""

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

    def geometry(self) -> DifferentialDrive:
        """Return the same numbers for the protocols; DriverError for a size that is not finite and above 0."""
        return DifferentialDrive(**asdict(self))


@dataclass(frozen=True, slots=True)
class MotorSettings:
    """The motor controller: where it is, its protocol, how often it gets a command."""

    port: Annotated[str, "serial port of the motor controller, or simulated; empty: none"] = ""
    protocol: Annotated[str, "line, roboteq, odrive_ascii, vesc, or a protocol of another package"] = "line"
    baud: Annotated[int, Meta(ge=0, le=4_000_000), "bits per second; 0: the protocol's own"] = 0
    boot_s: Annotated[
        float,
        Meta(ge=0.1, le=600),
        "a motor controller may take so long to boot when its port is opened; it is asked on after that, s",
    ] = 10.0
    rate_hz: Annotated[float, Meta(ge=5, le=200), "commands per second"] = 20.0
    watchdog_ms: Annotated[
        int,
        Meta(ge=50, le=10_000),
        "the motor controller stops the wheels by itself after so long without a command, ms",
    ] = 500
    drive: DriveSettings = field(default_factory=DriveSettings)
