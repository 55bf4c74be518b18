"""The process that steers the base. It has one thread, so that no tick waits for a lock, and loads no perception.

The daemon starts it, sends it poses and setpoints, and receives a report of each tick. When the daemon dies, for
whatever reason, the wheels slow down to a stop; signals that end the daemon do not end this process.
"""

from __future__ import annotations

import signal
import socket
import sys
import time
from contextlib import ExitStack
from typing import Final

from drivers.errors import DriverError
from omnid.controller.controller import Controller
from omnid.controller.ipc import (
    LONGEST_RAMP_S,
    NO_MESSAGE,
    Channel,
    ControllerStart,
    ControllerUpdate,
    LogRecord,
    StartFailed,
)
from omnid.controller.motor import open_motor
from omnid.core.nanoseconds import S_PER_NS
from omnid.engine.process import STOP_SIGNALS, prepare, start_thread

THREAD_NAME: Final = "controller"
MAX_OVERDUE: Final = 500  # messages received while a tick is due already: more than can wait in the channel
ABORTING: Final = signal.SIGABRT  # systemd ends a daemon that does not respond by this, and all its processes


def run_controller(channel: Channel) -> int:
    """Run as the daemon's first message says; return the exit code, 2 where it cannot start."""
    with ExitStack() as closing:
        closing.callback(channel.close)  # last of all, when the wheels are at rest
        start: ControllerStart = channel.receive(LONGEST_RAMP_S)
        try:
            driver = open_motor(start.motor, closing, waits=False)
        except DriverError as error:
            channel.send(StartFailed(str(error)))
            return 2
        # Memory, garbage collection and priority, for punctual ticks.
        prepare()
        channel.send(LogRecord(start_thread(THREAD_NAME, start.realtime.motor_priority)))
        controller = Controller(
            driver,
            start.controller,
            1.0 / start.motor.rate_hz,
            lambda text: channel.send(LogRecord(text)),
            limited=start.motor.drive.limited,
            is_awaited=True,
        )
        run_until_end(channel, controller)
    return 0


def run_until_end(channel: Channel, controller: Controller) -> None:
    """Tick in time, and receive messages in between, until the daemon sends no more and the wheels are at rest."""
    until_ns = 0  # once the daemon sends no more: when the wheels must have stopped
    while not until_ns or not (controller.is_at_rest or time.monotonic_ns() > until_ns):
        if not until_ns and not receive_until_due(channel, controller):
            controller.end()
            until_ns = time.monotonic_ns() + round(LONGEST_RAMP_S / S_PER_NS)
        if until_ns:
            time.sleep(max(0.0, (controller.due_ns - time.monotonic_ns()) * S_PER_NS))
        channel.send(controller.tick())


def receive_until_due(channel: Channel, controller: Controller) -> bool:
    """Pass on all messages until the tick is due, and those that wait then; False if the daemon sends no more."""
    overdue = 0
    while overdue < MAX_OVERDUE:
        left_s = (controller.due_ns - time.monotonic_ns()) * S_PER_NS
        overdue += left_s <= 0
        try:
            message = channel.receive(left_s)
        except EOFError:
            return False
        if message is not NO_MESSAGE:
            update: ControllerUpdate = message
            controller.stop(update.stop_ns)
            controller.touch(update.contacts)
            if update.update is not None:
                controller.take(update.update)
        elif left_s <= 0:
            return True
    return True


def main() -> int:
    """Run the process; its argument is the file descriptor of its end of the channel."""
    for number in (*STOP_SIGNALS, ABORTING):
        signal.signal(number, signal.SIG_IGN)
    return run_controller(Channel(socket.socket(fileno=int(sys.argv[1]))))


if __name__ == "__main__":
    sys.exit(main())
