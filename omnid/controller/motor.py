"""The motor controller of the settings, opened; or its simulation."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Final

from drivers.errors import DriverError
from drivers.motor import MotorDriver
from drivers.motors.protocols.protocol_registry import motor_protocol
from drivers.motors.serial_motor import SerialMotor
from omnid.controller.motor_settings import MotorSettings

SIMULATED: Final = "simulated"
# Share of a tick's time that an answer may take: a missing one must not make the next tick late.
ANSWER_SHARE: Final = 0.8
WATCHDOG_TICKS: Final = 4  # Least watchdog_ms in ticks: after a pause of half of it the driver sends a stop first.


def open_motor(config: MotorSettings, closing: ExitStack, *, waits: bool = True) -> MotorDriver:
    """Return the driver of the configured port, or of a simulated motor controller where the port is "simulated".

    closing closes it. waits: for an answer, and DriverError where there is none; otherwise `send` asks for it.
    DriverError for a watchdog so short that one or two late ticks would let it expire.
    """
    least_ms = WATCHDOG_TICKS * 1000 / config.rate_hz
    if config.watchdog_ms < least_ms:
        raise DriverError(
            f"motor.watchdog_ms is {config.watchdog_ms} at motor.rate_hz {config.rate_hz:g}; "
            f"give at least {least_ms:.0f}, {WATCHDOG_TICKS} ticks, or a higher rate"
        )
    drive = config.drive.geometry()
    protocol = motor_protocol(config.protocol)(drive)
    if config.port == SIMULATED:
        # A real robot's process does not load the simulation.
        from drivers.motors.simulated.simulated_motor import SimulatedMotor

        driver: MotorDriver = SimulatedMotor(drive, config.watchdog_ms, time.monotonic_ns)
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
