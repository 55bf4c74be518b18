"""The motor controller: its settings, and its driver, or that of its simulation."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Annotated, Final

from msgspec import Meta

from drivers.errors import DriverError
from drivers.motor import MotorDriver
from drivers.motors.protocols.motor_protocol import DifferentialDrive

SIMULATED: Final = "simulated"
# Share of a tick's time that an answer may take: a missing one must not make the next tick late.
ANSWER_SHARE: Final = 0.8
WATCHDOG_TICKS: Final = 4  # Least watchdog_ms in ticks: after a pause of half of it the driver sends a stop first.


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
    drive: DifferentialDrive = field(default_factory=DifferentialDrive)


def open_motor(config: MotorSettings, closing: ExitStack, *, waits: bool = True) -> MotorDriver:
    """Return the driver of the configured port, or of a simulated motor controller where the port is "simulated".

    closing: closes the driver. waits: for an answer, and DriverError where there is none; otherwise `send` asks for it.
    DriverError for a watchdog so short that one or two late ticks would let it expire.
    """
    # Settings are read where no device is opened, so that only this function loads the drivers.
    from drivers.motors.serial_motor import SerialMotor, motor_protocol
    from drivers.motors.simulated_motor import SimulatedMotor

    least_ms = WATCHDOG_TICKS * 1000 / config.rate_hz
    if config.watchdog_ms < least_ms:
        raise DriverError(
            f"motor.watchdog_ms is {config.watchdog_ms} at motor.rate_hz {config.rate_hz:g}; "
            f"give at least {least_ms:.0f}, {WATCHDOG_TICKS} ticks, or a higher rate"
        )
    protocol = motor_protocol(config.protocol)(config.drive)
    if config.port == SIMULATED:
        driver: MotorDriver = SimulatedMotor(config.drive, config.watchdog_ms, time.monotonic_ns)
    else:
        driver = SerialMotor(
            config.port,
            protocol,
            baud=config.baud,
            timeout_s=ANSWER_SHARE / config.rate_hz,
            watchdog_ms=config.watchdog_ms,
            connect_s=config.boot_s if waits else 0.0,
        )
    closing.callback(driver.close)
    return driver
