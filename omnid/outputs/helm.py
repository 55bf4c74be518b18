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
from drivers.motor import MotorDriver, MotorStatus, VelocityCommand
from omnid.core.command_limits import STOP, CommandLimits
from omnid.core.ego_motion import LOST
from omnid.core.fail_safe import COMMAND_STALE, IDLE, Deadlines, Situation, reason_to_stop
from omnid.core.heading import Drive, HeadingHold, HeadingLimits, Setpoint
from omnid.core.heading_goal import HeadingGoal
from omnid.flow import Slot, nothing
from omnid.messages import Odometry
from omnid.stages.odometry import of_base
from omnid.telemetry import Histogram

LONGEST_RAMP_S = 3.0  # at the end: whatever has not stood still by then is stopped at once
TOLD = 16  # commands that may wait for whoever records them
SURE = ("", IDLE, COMMAND_STALE)  # reasons for which the pose has been found good
NS = 1e-9


class Heading(NamedTuple):
    """What the wheels need of a pose."""

    stamp_ns: int  # of the capture
    heading_rad: float  # of the base in odom
    yaw_rate_radps: float
    state: str

    def at(self, now_ns: int) -> float:
        """The heading now, if the base has gone on turning."""
        return self.heading_rad + self.yaw_rate_radps * (now_ns - self.stamp_ns) * NS


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
                 report: Callable[[str], None] = nothing, *, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._driver, self._T_base_rig, self._settings, self._report = driver, T_base_rig, settings, report
        self._clock_ns = clock_ns  # that of the pictures' stamps
        self._hold, self._goal = HeadingHold(settings.hold), HeadingGoal()
        self._pose: Slot[Heading] = Slot()
        self._command: Slot[Arrived] = Slot()
        self._void_ns = self._clock_ns()  # commands up to then count no more
        self._stop_ns = 0  # when a stop was asked for last
        self._last_ns = self._due_ns = 0  # when the last tick came, and when the next one should
        self._driven_ns = 0  # capture of the newest pose that was driven by
        self._ending = self._failed = self._stopped = False
        self._sent = STOP
        self._told: Queue[VelocityCommand | None] = Queue(TOLD)
        self.reason = IDLE
        self.stops: Counter[str] = Counter()  # by reason
        self.sent = self.errors = self.expiries = 0
        self.fault = 0  # the controller's own number
        self.to_wheel = Histogram()  # s from the capture of a pose's pictures to the first command that follows it
        self.lateness = Histogram()  # s by which ticks come too late

    @property
    def failed(self) -> bool:
        """Whether the controller did not take the last command."""
        return self._failed

    def process(self, odometry: Odometry) -> None:
        """Takes a pose; one that is not finite is as good as none."""
        T_odom_base, _, velocity, _ = of_base(odometry, self._T_base_rig)
        heading_rad, rate_radps = float(se3.yaw(T_odom_base)), float(velocity[5])
        state = odometry.state if math.isfinite(heading_rad) and math.isfinite(rate_radps) else LOST
        self._pose.put(Heading(odometry.stamp_ns, heading_rad, rate_radps, state))

    def command(self, setpoint: Setpoint, arrival_ns: int | None = None) -> None:
        """Takes a command that arrived then (CLOCK_MONOTONIC), or just now, from any thread; the newest wins."""
        self._command.put(Arrived(self._clock_ns() if arrival_ns is None else arrival_ns, setpoint))

    def stop(self) -> None:
        """Stops the wheels at the next tick, whatever else is commanded until then; from any thread."""
        self._stop_ns = self._clock_ns()  # a time, for a flag could be cleared by the tick the moment it is set

    def __call__(self) -> None:
        """One tick."""
        now_ns = self._clock_ns()
        dt_s, late_s = self._rhythm(now_ns)
        pose, command = self._pose.get(), self._command.get()
        self._judge(self._situation(now_ns, late_s, pose, command), now_ns)
        drive, goal_rad = self._steered(now_ns, dt_s, pose, command)
        if (status := self._send(VelocityCommand(now_ns, drive.velocity_mps, goal_rad, drive.yaw_rate_radps))) is None:
            return
        self._heed(status, drive)
        self._goal.heard(status.heading_rad, pose.at(now_ns) if pose and self.reason in SURE else None)
        if pose is not None and pose.stamp_ns > self._driven_ns:
            self._driven_ns = pose.stamp_ns
            self.to_wheel.add((self._clock_ns() - pose.stamp_ns) * NS)

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
        with suppress(Full):  # by another that hushes: then there is an end already
            self._told.put_nowait(None)

    def close(self) -> None:
        """Slows down to a stand, then releases the driver; the wheels stand when this returns."""
        self._ending = True
        deadline_ns = self._clock_ns() + round(LONGEST_RAMP_S / NS)
        try:
            while self._sent != STOP and not self._failed and self._clock_ns() < deadline_ns:
                self()
                time.sleep(max(0.0, (self._due_ns - self._clock_ns()) * NS))
        finally:
            self._driver.close()

    def _rhythm(self, now_ns: int) -> tuple[float, float]:
        """Seconds since the last tick, and by how much this one comes later than in step with the earliest ones."""
        period_ns = round(self._settings.period_s * 1e9)  # as the graph's ticker has it
        dt_ns = now_ns - self._last_ns if self._last_ns else period_ns
        self._last_ns = now_ns
        due_ns = min(self._due_ns or now_ns, now_ns)
        self._due_ns = due_ns + (1 + (now_ns - due_ns) // period_ns) * period_ns
        self.lateness.add((now_ns - due_ns) * NS)
        return dt_ns * NS, (now_ns - due_ns) * NS

    def _situation(self, now_ns: int, late_s: float, pose: Heading | None, command: Arrived | None) -> Situation:
        valid = command is not None and command.arrival_ns > self._void_ns
        return Situation(
            pose_age_s=math.inf if pose is None else (now_ns - pose.stamp_ns) * NS,
            pose_state="" if pose is None else pose.state,
            command_age_s=(now_ns - command.arrival_ns) * NS if command is not None and valid else math.inf,
            late_s=late_s, motor_failed=self._failed, motor_stopped=self._stopped,
            stop_asked=self._stop_ns > self._void_ns, ending=self._ending)

    def _judge(self, situation: Situation, now_ns: int) -> None:
        """Notes why the wheels must stand, if they must; voids the commands so far, and counts what stopped a drive."""
        before, self.reason = self.reason, reason_to_stop(situation, self._settings.deadlines)
        if not self.reason:
            return
        self._void_ns = now_ns
        if not before:
            self.stops[self.reason] += 1
            self._report(f"the wheels stop: {self.reason}")

    def _steered(self, now_ns: int, dt_s: float, pose: Heading | None, command: Arrived | None) -> tuple[Drive, float]:
        """The drive within the limits, and the controller's heading that it leads to."""
        if self.reason or pose is None or command is None:
            return self._settings.limits.step(STOP, self._sent, dt_s), self._goal.stay()
        heading_rad = pose.at(now_ns)
        wanted = self._hold.step(command.setpoint, heading_rad, dt_s, self._sent)
        drive = self._settings.limits.step(wanted, self._sent, dt_s)
        return drive, self._goal.towards(command.setpoint, heading_rad, drive.yaw_rate_radps * dt_s)

    def _send(self, command: VelocityCommand) -> MotorStatus | None:
        """The controller's answer; None where it gave none."""
        try:
            status = self._driver.send(command)
        except DriverError as error:
            if not self._failed:
                self._report(str(error))
            self._failed, self._sent = True, STOP  # its own watchdog stops a controller that hears nothing
            self.errors += 1
            return None
        if self._failed:
            self._report("the motor controller is back")
        self._failed = False
        self.sent += 1
        with suppress(Full):
            self._told.put_nowait(command)
        return status

    def _heed(self, status: MotorStatus, drive: Drive) -> None:
        """Takes to heart what the controller says: one that has stopped by itself did not obey."""
        self._stopped = status.watchdog_expired
        self.expiries += status.watchdog_expired
        self._sent = STOP if status.watchdog_expired else drive
        self.fault = status.fault
