"""The wheels of a live robot: at a fixed rate, from the newest pose and the newest command, whatever the stages do."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, Full, Queue
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.errors import DriverError
from drivers.motor import MotorDriver, VelocityCommand
from omnid.core.command_limits import STOP, CommandLimits
from omnid.core.fail_safe import IDLE, Deadlines, Situation, reason_to_stop
from omnid.core.heading import Drive, HeadingHold, HeadingLimits, Setpoint
from omnid.flow import Slot, nothing
from omnid.messages import Odometry
from omnid.stages.odometry import of_base
from omnid.telemetry import Histogram

LONGEST_RAMP_S = 3.0  # at the end: whatever has not stood still by then is stopped at once
TOLD = 16  # commands that may wait for whoever records them
NS = 1e-9


class Heading(NamedTuple):
    """What the wheels need of a pose."""

    stamp_ns: int  # of the capture
    heading_rad: float  # of the base in odom
    yaw_rate_radps: float
    state: str


class Arrived(NamedTuple):
    """A command and when it came."""

    arrival_ns: int
    setpoint: Setpoint


@dataclass(frozen=True, slots=True)
class HelmSettings:
    """How the wheels are driven."""

    period_s: float
    deadlines: Deadlines = field(default_factory=Deadlines)
    hold: HeadingLimits = field(default_factory=HeadingLimits)
    limits: CommandLimits = field(default_factory=CommandLimits)


class Helm:
    """A sink for poses, a mailbox for commands, and the tick that drives.

    It stops, with the deceleration of its limits, for every reason of omnid.core.fail_safe. A stop voids all commands
    that came before it: only one that comes later moves the wheels again.
    """

    def __init__(self, driver: MotorDriver, T_base_rig: NDArray[np.float64], settings: HelmSettings,
                 report: Callable[[str], None] = nothing) -> None:
        self._driver, self._T_base_rig, self._settings, self._report = driver, T_base_rig, settings, report
        self._hold = HeadingHold(settings.hold)
        self._pose: Slot[Heading] = Slot()
        self._command: Slot[Arrived] = Slot()
        self._stop_asked = self._ending = self._failed = False
        self._void_ns = time.monotonic_ns()  # commands up to then count no more
        self._last_tick_ns: int | None = None
        self._driven_ns = 0  # capture of the newest pose that was driven by
        self._sent = STOP
        self.reason = IDLE
        self.stops: Counter[str] = Counter()  # by reason
        self._told: Queue[VelocityCommand | None] = Queue(TOLD)
        self.sent = self.errors = 0
        self.to_wheel = Histogram()  # s from the capture of a pose's pictures to the first command that follows it
        self.lateness = Histogram()  # s by which ticks come too late

    def process(self, odometry: Odometry) -> None:
        """Takes a pose."""
        T_odom_base, _, velocity, _ = of_base(odometry, self._T_base_rig)
        self._pose.put(Heading(odometry.stamp_ns, float(se3.yaw(T_odom_base)), float(velocity[5]), odometry.state))

    def command(self, setpoint: Setpoint) -> None:
        """Takes a command that has just arrived, from any thread; the newest wins."""
        self._command.put(Arrived(time.monotonic_ns(), setpoint))

    def stop(self) -> None:
        """Stops the wheels at the next tick, whatever else is commanded until then; from any thread."""
        self._stop_asked = True

    def __call__(self) -> None:
        """One tick."""
        now_ns = time.monotonic_ns()
        dt_s = self._settings.period_s if self._last_tick_ns is None else (now_ns - self._last_tick_ns) * NS
        self._last_tick_ns = now_ns
        late_s = max(0.0, dt_s - self._settings.period_s)
        self.lateness.add(late_s)
        pose, command = self._pose.get(), self._valid_command()
        self._judge(self._situation(now_ns, late_s, pose, command), now_ns)
        wanted, goal_rad = self._wanted(now_ns, dt_s, pose, command)
        self._send(self._settings.limits.step(wanted, self._sent, dt_s), goal_rad, now_ns)
        if pose is not None and pose.stamp_ns > self._driven_ns:
            self._driven_ns = pose.stamp_ns
            self.to_wheel.add((time.monotonic_ns() - pose.stamp_ns) * NS)

    def finish(self) -> None:
        """There will be no more poses."""
        self.hush()

    def told(self) -> Iterator[VelocityCommand]:
        """What the wheels have been told, for whoever keeps or shows it, until hushed; too much of it is forgotten."""
        while (command := self._told.get()) is not None:
            yield command

    def hush(self) -> None:
        """Ends `told`; for any thread."""
        with suppress(Empty):
            while True:
                self._told.get_nowait()
        self._told.put(None)

    def close(self) -> None:
        """Slows down to a stand, then releases the driver; the wheels stand when this returns."""
        self._ending = True
        deadline_ns = time.monotonic_ns() + round(LONGEST_RAMP_S / NS)
        while self._sent != STOP and not self._failed and time.monotonic_ns() < deadline_ns:
            self()
            time.sleep(self._settings.period_s)
        self._driver.close()

    def _valid_command(self) -> Arrived | None:
        command = self._command.get()
        return command if command is not None and command.arrival_ns > self._void_ns else None

    def _situation(self, now_ns: int, late_s: float, pose: Heading | None, command: Arrived | None) -> Situation:
        asked, self._stop_asked = self._stop_asked, False
        return Situation(
            pose_age_s=math.inf if pose is None else (now_ns - pose.stamp_ns) * NS,
            pose_state="" if pose is None else pose.state,
            command_age_s=math.inf if command is None else (now_ns - command.arrival_ns) * NS,
            late_s=late_s, motor_failed=self._failed, stop_asked=asked, ending=self._ending)

    def _judge(self, situation: Situation, now_ns: int) -> None:
        """Notes why the wheels must stand, if they must; voids the commands so far, and counts what stopped a drive."""
        before, self.reason = self.reason, reason_to_stop(situation, self._settings.deadlines)
        if not self.reason:
            return
        self._void_ns = now_ns
        if not before:
            self.stops[self.reason] += 1
            self._report(f"the wheels stop: {self.reason}")

    def _wanted(self, now_ns: int, dt_s: float, pose: Heading | None, command: Arrived | None) -> tuple[Drive, float]:
        """The drive that the command asks for, and the heading it leads to."""
        if self.reason or pose is None or command is None:
            return STOP, 0.0
        heading_rad = pose.heading_rad + pose.yaw_rate_radps * (now_ns - pose.stamp_ns) * NS
        wanted = self._hold.step(command.setpoint, heading_rad, dt_s, self._sent)
        goal_rad = command.setpoint.heading_rad
        return wanted, heading_rad if goal_rad is None else goal_rad

    def _send(self, drive: Drive, goal_rad: float, now_ns: int) -> None:
        command = VelocityCommand(now_ns, drive.velocity_mps, goal_rad, drive.yaw_rate_radps)
        try:
            self._driver.send(command)
        except DriverError as error:
            if not self._failed:
                self._report(str(error))
            self._failed, self._sent = True, STOP  # its own watchdog stops a controller that hears nothing
            self.errors += 1
            return
        self._failed, self._sent = False, drive
        self.sent += 1
        with suppress(Full):
            self._told.put_nowait(command)
