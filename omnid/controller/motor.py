"""Commands to the wheels at a fixed rate, whatever the stages do: the newest one, or a stop when it is stale."""

from __future__ import annotations

import time
from contextlib import ExitStack

from drivers.errors import DriverError
from drivers.motor import MotorDriver, VelocityCommand, stop_command
from drivers.motors.protocols.protocol_registry import PROTOCOLS
from drivers.motors.serial_motor import NoReplyError, SerialMotor
from drivers.motors.simulated.controller_registry import SIMULATED_CONTROLLERS
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from omnid.config import MotorConfig
from omnid.engine.graph import Slot

SIMULATED = "simulated"
SILENCE_S = 3.0
ANSWER_SHARE = 0.8  # of a tick's time may go by until the answer: silence must not make the next tick late
WATCHDOG_TICKS = 4  # the least that fits in; the driver tells a stop first after a pause of half the watchdog


class MotorTick:
    """A sink that keeps the newest command with its time of arrival, and the action that sends it.

    A controller that fails is asked again with each tick. It is given up after stale_s, or after SILENCE_S where it
    only stays silent: a busy host may be late with hearing it, and its own watchdog stops the wheels long before.
    """

    def __init__(self, driver: MotorDriver, stale_s: float) -> None:
        self._driver, self._stale_ns = driver, round(stale_s * 1e9)
        self._newest: Slot[tuple[int, VelocityCommand]] = Slot()
        self._failing: tuple[int, DriverError] | None = None  # since when, and by what
        self.sent = self.stops = self.errors = 0

    def process(self, command: VelocityCommand) -> None:
        """Takes a command, at any rate."""
        self._newest.put((time.monotonic_ns(), command))

    def __call__(self) -> None:
        """Sends one command now."""
        newest = self._newest.get()
        fresh = newest is not None and time.monotonic_ns() - newest[0] <= self._stale_ns
        self._send(newest[1] if newest is not None and fresh else stop_command(0))
        self.stops += not fresh

    def _send(self, command: VelocityCommand) -> None:
        try:
            self._driver.send(command)
            self.sent += 1
            self._failing = None
        except DriverError as error:
            self.errors += 1
            since_ns, first = self._failing = self._failing or (time.monotonic_ns(), error)
            patience_ns = SILENCE_S * 1e9 if isinstance(error, NoReplyError) else self._stale_ns
            if time.monotonic_ns() - since_ns > patience_ns:
                raise first from None

    def close(self) -> None:
        """Stops the wheels and releases the port."""
        self._driver.close()


def open_motor(config: MotorConfig, closing: ExitStack) -> tuple[SerialMotor, SimulatedMotor | None]:
    """The motor on the configured port, and its simulation where that is asked for.

    DriverError where it is silent, and for a watchdog so short that a tick or two late would trip it.
    """
    least_ms = WATCHDOG_TICKS * 1000 / config.rate_hz
    if config.watchdog_ms < least_ms:
        raise DriverError(f"motor.watchdog_ms is {config.watchdog_ms} at motor.rate_hz {config.rate_hz:g}; "
                          f"give at least {least_ms:.0f}, {WATCHDOG_TICKS} ticks, or a higher rate")
    twin = None
    if config.port == SIMULATED:
        twin = SimulatedMotor(SIMULATED_CONTROLLERS[config.protocol](config.drive.geometry()))
        closing.callback(twin.close)
    protocol = PROTOCOLS[config.protocol](config.drive.geometry())
    driver = SerialMotor(twin.port if twin else config.port, protocol, baud=config.baud,
                         timeout_s=ANSWER_SHARE / config.rate_hz, watchdog_ms=config.watchdog_ms)
    closing.callback(driver.close)
    return driver, twin
