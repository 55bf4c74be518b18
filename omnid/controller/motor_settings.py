"""Settings of the motor controller and of the base; imports nothing that opens a device."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

from drivers.motors.protocols.differential_drive import DifferentialDrive
from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """Geometry and wiring of a base with two driven sides."""

    track_m: float = knob(
        0.3,
        "distance of the left and the right wheels, m; where they skid: the one that makes measured turns right",
        low=0.01,
        high=10,
    )
    wheel_radius_m: float = knob(0.05, "radius of the wheels, m", low=0.001, high=5)
    max_wheel_mps: float = knob(1.0, "highest speed of a wheel, m/s", low=0.001, high=20)
    gear: float = knob(1.0, "turns of the motor per turn of the wheel", low=0.001, high=10_000)
    pole_pairs: int = knob(7, "vesc: pole pairs of the motor", low=1, high=100)
    reverse_left: bool = knob(False, "the left motor turns the other way round")
    reverse_right: bool = knob(False, "the right motor turns the other way round")
    swapped: bool = knob(False, "the motor controller's first motor is the right one")
    can_id: int = knob(1, "vesc: id of the second motor's controller", low=0, high=253)

    def geometry(self) -> DifferentialDrive:
        """Return the same numbers for the protocols; DriverError for a size that is not finite and above 0."""
        return DifferentialDrive(**asdict(self))


@dataclass(frozen=True, slots=True)
class MotorSettings:
    """The motor controller: where it is, its protocol, how often it gets a command."""

    port: str = knob("", "serial port of the motor controller, or simulated; empty: none")
    protocol: str = knob("line", "line, roboteq, odrive_ascii, vesc, or a protocol of another package")
    baud: int = knob(0, "bits per second; 0: the protocol's own", low=0, high=4_000_000)
    rate_hz: float = knob(20.0, "commands per second", low=5, high=200)
    watchdog_ms: int = knob(
        500, "the motor controller stops the wheels by itself after so long without a command, ms", low=50, high=10_000
    )
    drive: DriveSettings = field(default_factory=DriveSettings)
