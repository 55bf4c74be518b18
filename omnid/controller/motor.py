"""The motor controller of the settings, opened; or its simulation."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from drivers.errors import DriverError
from drivers.motors.protocols.protocol_registry import motor_protocol
from drivers.motors.serial_motor import SerialMotor
from omnid.controller.motor_settings import MotorSettings

if TYPE_CHECKING:
    from drivers.motors.simulated.simulated_motor import SimulatedMotor

SIMULATED: Final = "simulated"
# Share of a tick's time that an answer may take: a missing one must not make the next tick late.
ANSWER_SHARE: Final = 0.8
WATCHDOG_TICKS: Final = 4  # Least watchdog_ms in ticks: after a pause of half of it the driver sends a stop first.


def open_motor(
    config: MotorSettings, closing: ExitStack, *, waits: bool = True
) -> tuple[SerialMotor, SimulatedMotor | None]:
    """Return the driver of the configured port, and the simulated motor controller where the port is "simulated".

    closing closes both. waits: for an answer, and DriverError where there is none; otherwise `send` asks for it.
    DriverError for a watchdog so short that one or two late ticks would let it expire.
    """
    least_ms = WATCHDOG_TICKS * 1000 / config.rate_hz
    if config.watchdog_ms < least_ms:
        raise DriverError(
            f"motor.watchdog_ms is {config.watchdog_ms} at motor.rate_hz {config.rate_hz:g}; "
            f"give at least {least_ms:.0f}, {WATCHDOG_TICKS} ticks, or a higher rate"
        )
    simulated = _simulated(config, closing) if config.port == SIMULATED else None
    driver = SerialMotor(
        simulated.port if simulated else config.port,
        motor_protocol(config.protocol)(config.drive.geometry()),
        baud=config.baud,
        timeout_s=ANSWER_SHARE / config.rate_hz,
        watchdog_ms=config.watchdog_ms,
        connect_s=config.boot_s if waits else 0.0,
    )
    closing.callback(driver.close)
    return driver, simulated


def _simulated(config: MotorSettings, closing: ExitStack) -> SimulatedMotor:
    # A real robot's process does not load the simulation.
    from drivers.motors.simulated.simulated_motor import SimulatedMotor, simulated_controller

    simulated = SimulatedMotor(simulated_controller(config.protocol, config.drive.geometry()))
    closing.callback(simulated.close)
    return simulated
