"""The daemon's end of the helm: starts the process that steers, tells it poses and commands, keeps its logbook."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from omnid.controller.controller import NS, ControllerPose, TimedSetpoint
from omnid.controller.ipc import NOTHING, Channel, pair
from omnid.controller.messages import LONGEST_RAMP_S, ControllerStart, ControllerUpdate, LogRecord, StartFailed
from omnid.controller.statistics import ControllerStatistics, TickReport
from omnid.core.control.heading_controller import Setpoint
from omnid.engine.telemetry import StageStats
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.stages.odometry import of_base
from omnid.tracking_state import TrackingState

START_S: Final = 30.0  # some boards start anew when their port is opened
END_S: Final = LONGEST_RAMP_S + 2.0
LOOK_S: Final = 0.5
PROCESS: Final = "omnid.controller.process"


class ControllerLink:
    """A sink for poses, a mailbox for commands, and a source of what the wheels were told.

    The tick is not in here but in a process of its own, which no stage can hold up. `stop` rides along with
    all that is said after it, so that it arrives whatever was lost.
    """

    def __init__(self, orders: ControllerStart, T_base_rig: NDArray[np.float64], stats: StageStats,
                 report: Callable[[str], None]) -> None:
        """Starts the process; DriverError where the controller is not there."""
        self._T_base_rig, self._report = T_base_rig, report
        self.logbook = ControllerStatistics(stats)
        self._stop_ns = 0
        self._ended_ns = 0  # when it was told to end
        here, there = pair()
        self._line = Channel(here)
        with there:
            self._process = _started(there.fileno())
        self._line.say(orders)
        try:
            self._hear_the_first_word()
        except BaseException:
            self.close()
            raise

    def process(self, odometry: OdometryUpdate) -> None:
        """Passes a pose on."""
        self._say(heading_of(odometry, self._T_base_rig))

    def command(self, setpoint: Setpoint, arrival_ns: int) -> None:
        """Passes a command on that arrived then (CLOCK_MONOTONIC), from any thread; the newest wins."""
        self._say(TimedSetpoint(arrival_ns, setpoint))

    def stop(self) -> None:
        """Stops the wheels, whatever was commanded until now; from any thread."""
        self._stop_ns = time.monotonic_ns()
        self._say(None)

    def finish(self) -> None:
        """There will be no more poses."""
        self.end()

    def end(self) -> None:
        """Has the wheels slow down to a stand and the process end; for any thread."""
        self._ended_ns = self._ended_ns or time.monotonic_ns()
        self._line.hang_up()

    def told(self) -> Iterator[VelocityCommand]:
        """What the wheels are told from now on, until the process ends; OmnidError where nobody had asked it to."""
        since_ns = time.monotonic_ns()  # it has stood and ticked since before the stages began
        with suppress(EOFError):
            while not self._overdue():
                thing = self._line.hear(LOOK_S)
                if isinstance(thing, TickReport):
                    self.logbook.add(thing)
                    if thing.command is not None and thing.command.stamp_ns >= since_ns:
                        yield thing.command
                elif isinstance(thing, LogRecord):
                    self._report(thing.text)
        self.logbook.close()
        if not self._ended_ns:
            raise OmnidError(self._epitaph())

    def close(self) -> None:
        """The process has ended when this returns; a second call does nothing."""
        self.end()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._line.close()

    def _say(self, news: ControllerPose | TimedSetpoint | None) -> None:
        self._line.say(ControllerUpdate(self._stop_ns, news))

    def _overdue(self) -> bool:
        return bool(self._ended_ns) and (time.monotonic_ns() - self._ended_ns) * NS > END_S

    def _hear_the_first_word(self) -> None:
        try:
            word = self._line.hear(START_S)
        except EOFError:
            raise OmnidError(self._epitaph()) from None
        if word is NOTHING:
            raise OmnidError(f"the process that steers did not start within {START_S:.0f} s: is the host overloaded?")
        if isinstance(word, StartFailed):
            raise DriverError(word.why)
        if word.text:
            self._report(word.text)

    def _epitaph(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        return (f"the process that steers has ended unasked, with exit code {self._process.returncode}; the "
                "controller's own watchdog stops the wheels: start the daemon again")


def heading_of(odometry: OdometryUpdate, T_base_rig: NDArray[np.float64]) -> ControllerPose:
    """What the wheels need of a pose; one that is not finite is as good as none."""
    T_odom_base, _, velocity, _ = of_base(odometry, T_base_rig)
    heading_rad, rate_radps = float(se3.yaw(T_odom_base)), float(velocity[5])
    state = odometry.state if math.isfinite(heading_rad) and math.isfinite(rate_radps) else TrackingState.LOST
    return ControllerPose(odometry.stamp_ns, heading_rad, rate_radps, state)


def _started(descriptor: int) -> subprocess.Popen[bytes]:
    """The process, with our own modules and none of the folder it is started in; Ctrl-C in a terminal is not for it."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen([sys.executable, "-P", "-m", PROCESS, str(descriptor)], pass_fds=(descriptor,),
                            stdin=subprocess.DEVNULL, env=environment, start_new_session=True)
