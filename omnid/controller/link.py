"""The daemon's end of the controller: starts its process, sends it poses and setpoints, receives its reports."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final, Protocol

from drivers.errors import DriverError
from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.controller.ipc import (
    LONGEST_RAMP_S,
    NO_MESSAGE,
    Channel,
    ControllerStart,
    ControllerUpdate,
    LogRecord,
    StartFailed,
    TickReport,
    socket_pair,
)
from omnid.core.control.arming import NO_CONTACT
from omnid.core.control.control_law import ControlInput, ControllerState
from omnid.core.nanoseconds import S_PER_NS
from omnid.engine.graph import POLL_S, Histogram, StageStats, Stream
from omnid.engine.process import python, python_environment
from omnid.errors import OmnidError

START_S: Final = 30.0  # of the process, beyond the time in which the motor controller may boot
END_S: Final = LONGEST_RAMP_S + 2.0
PROCESS: Final = "omnid.controller.process"


class ControllerStatistics:
    """The newest state, and a histogram of lateness."""

    def __init__(self, stats: StageStats) -> None:
        """stats: the counters of the tick, among those of the stages; busy from one report to the next."""
        self.state = ControllerState()
        self.states: Stream[ControllerState] = Stream()  # of each tick
        self.wheels: Stream[WheelSample] = Stream()  # as the motor controller reports them
        self.lateness = Histogram()
        self._stats = stats

    def add(self, tick: TickReport) -> None:
        """Add the report of one tick."""
        self.state = tick.state
        self.states.push(tick.state)
        if tick.wheels is not None:
            self.wheels.push(tick.wheels)
        self.lateness.add(tick.late_s)
        self._stats.wall.add(tick.work_s)
        self._stats.processed += 1
        self._stats.busy_since_ns = time.monotonic_ns()

    def close(self) -> None:
        """Note that no more reports come."""
        self._stats.busy_since_ns = 0


class DriveLink(Protocol):
    """The daemon's end of a controller. All methods may be called from any thread; the newest of a kind counts.

    Arrivals are by CLOCK_MONOTONIC; a controller with another clock dates them by its own.
    """

    statistics: ControllerStatistics

    def send(self, given: ControlInput) -> None:
        """Send a pose, an obstacle scan, a setpoint, or a request to arm."""

    def stop(self) -> None:
        """Stop the wheels until a request to arm is sent later."""

    def touch(self, contact: str, *, holds: bool) -> None:
        """Report a bumper or a cliff sensor (BUMPER, CLIFF)."""

    def end(self) -> None:
        """Have the wheels slow down to a stop, and `commands` end."""

    def commands(self) -> Iterator[VelocityCommand]:
        """Yield the commands that are sent from now on, until the end."""


class ControllerLink:
    """Sends poses and setpoints to the controller, and receives its reports and commands.

    The tick runs in a process of its own, which no stage can delay. Every message carries the time of the last stop
    request, so that a stop arrives even where messages were lost.
    """

    def __init__(self, start: ControllerStart, stats: StageStats, report: Callable[[str], None]) -> None:
        """Start the process; DriverError where it refuses to start, OmnidError where it ends or does not answer."""
        self._report = report
        self.statistics = ControllerStatistics(stats)
        self._stop_ns, self._contacts = 0, NO_CONTACT
        self._ended_ns = 0  # when the process was asked to end
        here, there = socket_pair()
        self._channel = Channel(here)
        with there:  # in a session of its own, which Ctrl-C does not end
            self._process = subprocess.Popen(
                python("-m", PROCESS, str(there.fileno())),
                pass_fds=(there.fileno(),),
                stdin=subprocess.DEVNULL,
                env=python_environment(),
                start_new_session=True,
            )
        self._channel.send(start)
        try:
            self._await_start(START_S + start.motor.boot_s)
        except BaseException:
            self.close()
            raise

    def send(self, given: ControlInput | None) -> None:
        """Send a pose, an obstacle scan, a setpoint, or a request to arm, with the newest stop; from any thread.

        None: the stop alone. A request that is lost is not repeated: its sender sees that the robot is not armed.
        """
        self._channel.send(ControllerUpdate(self._stop_ns, given, self._contacts))

    def stop(self) -> None:
        """Stop the wheels until a request to arm is sent later; from any thread."""
        self._stop_ns = time.monotonic_ns()
        self.send(None)

    def touch(self, contact: str, *, holds: bool) -> None:
        """Report a bumper or a cliff sensor (BUMPER, CLIFF); the base stays at rest while it holds. From one thread."""
        self._contacts = self._contacts.after(contact, holds=holds)
        self.send(None)

    def end(self) -> None:
        """Have the wheels slow down to a stop and the process end; from any thread."""
        self._ended_ns = self._ended_ns or time.monotonic_ns()
        self._channel.finish_sending()

    def commands(self) -> Iterator[VelocityCommand]:
        """Yield the commands that are sent from now on, until the process ends; OmnidError where it ends unasked."""
        since_ns = time.monotonic_ns()  # the process has ticked, with the wheels stopped, since before the stages began
        with suppress(EOFError):
            while not self._ended_ns or (time.monotonic_ns() - self._ended_ns) * S_PER_NS <= END_S:
                message: object = self._channel.receive(POLL_S)
                if isinstance(message, LogRecord):
                    self._report(message.text)
                elif isinstance(message, TickReport):
                    self.statistics.add(message)
                    if message.command and message.command.stamp_ns >= since_ns:
                        yield message.command
        self._require_asked_end()

    def close(self) -> None:
        """Return when the process has ended; a second call does nothing."""
        self.end()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._channel.close()

    def _await_start(self, start_s: float) -> None:
        try:
            first = self._channel.receive(start_s)
        except EOFError:
            self._require_asked_end()
            return
        if first is NO_MESSAGE:
            raise OmnidError(f"the controller process did not start within {start_s:.0f} s: is the host overloaded?")
        if isinstance(first, StartFailed):
            raise DriverError(first.reason)
        if first.text:
            self._report(first.text)

    def _require_asked_end(self) -> None:
        """Note that no more reports come; OmnidError where the process was not asked to end."""
        self.statistics.close()
        if self._ended_ns:
            return
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        raise OmnidError(
            f"the controller process has ended unexpectedly, with exit code {self._process.returncode}; the motor "
            "controller's own watchdog stops the wheels: start omnid again"
        )
