"""The process that steers. It has one thread, so that no tick waits for what another thread holds.

The daemon starts it, tells it poses and commands, and hears of each tick. When the daemon dies, however it dies, the
wheels slow down to a stand; signals that end the daemon do not end this.
"""

from __future__ import annotations

import signal
import socket
import sys
import time
from contextlib import ExitStack
from typing import Final

from drivers.errors import DriverError
from omnid.config import RealtimeConfig
from omnid.controller.controller import NS, Controller, ControllerPose, TimedSetpoint
from omnid.controller.ipc import NOTHING, Channel
from omnid.controller.messages import LONGEST_RAMP_S, ControllerStart, ControllerUpdate, LogRecord, StartFailed
from omnid.controller.motor import open_motor
from omnid.engine.realtime import ThreadStart, prepare
from omnid.engine.signals import STOPPING

MOST_LATE: Final = 500  # packets heard when a tick is due already: more than may wait on the line
ORDERS_S: Final = 10.0
ABORTING: Final = signal.SIGABRT  # that is how systemd ends a daemon that is stuck, and all that belongs to it


class ControllerLoop:
    """Ticks in time, and hears in between."""

    def __init__(self, line: Channel, helm: Controller) -> None:
        self._line, self._helm = line, helm
        self._until_ns = 0  # once the daemon has hung up: until when the wheels may slow down

    def run(self) -> None:
        """Until the daemon has hung up and the wheels stand."""
        while not self._ended():
            self._listen()
            tick = self._helm()
            self._helm.account.untold = self._line.lost
            self._line.say(tick)

    def _ended(self) -> bool:
        return bool(self._until_ns) and (self._helm.stands or time.monotonic_ns() > self._until_ns)

    def _listen(self) -> None:
        """Takes all that is said until the tick is due, and what waits then."""
        late = 0
        while late < MOST_LATE:
            left_s = (self._helm.due_ns - time.monotonic_ns()) * NS
            late += left_s <= 0
            if self._until_ns:
                time.sleep(max(0.0, left_s))
                return
            if not self._hears(left_s) and left_s <= 0:
                return

    def _hears(self, timeout_s: float) -> bool:
        """Whether something was said within the time."""
        try:
            heard = self._line.hear(timeout_s)
        except EOFError:
            self._helm.end()
            self._until_ns = time.monotonic_ns() + round(LONGEST_RAMP_S / NS)
            return True
        if heard is NOTHING:
            return False
        self._take(heard)
        return True

    def _take(self, heard: ControllerUpdate) -> None:
        self._helm.stop(heard.stop_ns)
        if isinstance(heard.news, ControllerPose):
            self._helm.see(heard.news)
        elif isinstance(heard.news, TimedSetpoint):
            self._helm.command(heard.news)


def run_controller(line: Channel) -> int:
    """Does what the daemon orders; 2 where it cannot."""
    with ExitStack() as ends:
        ends.callback(line.close)  # last of all, when the wheels stand
        orders: ControllerStart = line.hear(ORDERS_S)
        try:
            driver, _ = open_motor(orders.motor, ends)
        except DriverError as error:
            line.say(StartFailed(str(error)))
            return 2
        line.say(LogRecord(settle(orders.realtime)))
        ControllerLoop(line, Controller(driver, orders.settings, lambda text: line.say(LogRecord(text)))).run()
    return 0


def settle(config: RealtimeConfig) -> str:
    """Makes the process as punctual as it may be; what it was refused, or ""."""
    prepare(config, opencv_threads=1)  # what it refuses to this process it has refused to the daemon
    refused: list[str] = []
    ThreadStart({"helm": config.motor_priority}, lambda _, line: refused.append(line))("helm")
    return " ".join(refused)


def main() -> int:
    """The process; its argument is the descriptor of its end of the line."""
    for number in (*STOPPING, ABORTING):
        signal.signal(number, signal.SIG_IGN)
    return run_controller(Channel(socket.socket(fileno=int(sys.argv[1]))))


if __name__ == "__main__":
    sys.exit(main())
