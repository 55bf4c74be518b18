"""Commands to the wheels at a fixed rate, whatever the stages do: the newest one, or a stop when it is stale."""

from __future__ import annotations

import time
from contextlib import ExitStack

from drivers.motor import MotorDriver, VelocityCommand, stop_command
from drivers.serial_motor import SerialMotor
from drivers.simulated_motor import SimulatedMotor
from omnid.config import MotorConfig
from omnid.graph import Slot

SIMULATED = "simulated"


class MotorTick:
    """A sink that keeps the newest command with its time of arrival, and the action that sends it."""

    def __init__(self, driver: MotorDriver, stale_s: float) -> None:
        self._driver, self._stale_ns = driver, round(stale_s * 1e9)
        self._newest: Slot[tuple[int, VelocityCommand]] = Slot()
        self.sent = self.stops = 0

    def process(self, command: VelocityCommand) -> None:
        """Takes a command, at any rate."""
        self._newest.put((time.monotonic_ns(), command))

    def __call__(self) -> None:
        """Sends one command now."""
        newest = self._newest.get()
        fresh = newest is not None and time.monotonic_ns() - newest[0] <= self._stale_ns
        self._driver.send(newest[1] if newest is not None and fresh else stop_command(0))
        self.sent += 1
        self.stops += not fresh

    def close(self) -> None:
        """Stops the wheels and releases the port."""
        self._driver.close()


def open_motor(config: MotorConfig, closing: ExitStack) -> tuple[MotorTick, SimulatedMotor | None]:
    """The motor on the configured port, and its simulation where that is asked for; DriverError where it is silent."""
    twin = None
    if config.port == SIMULATED:
        twin = SimulatedMotor()
        closing.callback(twin.close)
    driver = SerialMotor(twin.port if twin else config.port, config.baud, watchdog_ms=config.watchdog_ms)
    closing.callback(driver.close)
    return MotorTick(driver, config.stale_s), twin
