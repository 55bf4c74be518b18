"""The wheels of a live robot: at a fixed rate, from the newest pose and the newest command."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from drivers.errors import DriverError
from drivers.motor import MotorDriver, MotorStatus, VelocityCommand
from drivers.motors.serial_motor import LateReplyError
from omnid.controller.statistics import ControllerState, TickReport
from omnid.core.control.heading_controller import HeadingController, HeadingLimits, Setpoint, Twist
from omnid.core.control.heading_goal import HeadingGoal
from omnid.core.control.safety_rules import COMMAND_STALE, IDLE, Deadlines, SafetyInputs, stop_reason
from omnid.core.control.velocity_limits import STOP, VelocityLimits
from omnid.engine.flow import nothing

SURE = ("", IDLE, COMMAND_STALE)  # reasons for which the pose has been found good
NS = 1e-9


class ControllerPose(NamedTuple):
    """What the wheels need of a pose."""

    stamp_ns: int  # of the capture
    heading_rad: float  # of the base in odom
    yaw_rate_radps: float
    state: str

    def at(self, now_ns: int) -> float:
        """The heading now, if the base has gone on turning."""
        return self.heading_rad + self.yaw_rate_radps * (now_ns - self.stamp_ns) * NS


class TimedSetpoint(NamedTuple):
    """A command and when it came (CLOCK_MONOTONIC)."""

    arrival_ns: int
    setpoint: Setpoint


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """How the wheels are driven."""

    period_s: float
    deadlines: Deadlines = field(default_factory=Deadlines)
    hold: HeadingLimits = field(default_factory=HeadingLimits)
    limits: VelocityLimits = field(default_factory=VelocityLimits)


class Controller:
    """Takes poses and commands, the newest of which count, and drives with each call.

    It stops, with the deceleration of its limits, for every reason in omnid.core.control.safety_rules. A stop voids
    all commands that came before it: only a later one moves the wheels again. Not thread-safe.
    """

    def __init__(self, driver: MotorDriver, settings: ControllerSettings, report: Callable[[str], None] = nothing, *,
                 clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._driver, self._settings, self._report = driver, settings, report
        self._clock_ns = clock_ns  # that of the images' stamps
        self._hold, self._goal = HeadingController(settings.hold), HeadingGoal()
        self._pose: ControllerPose | None = None
        self._command: TimedSetpoint | None = None
        self._void_ns = self._clock_ns()  # commands up to then count no more
        self._stop_ns = 0  # when a stop was asked for last
        self._last_ns = self._due_ns = 0  # when the last tick came, and when the next one should
        self._driven_ns = 0  # capture of the newest pose that was driven by
        self._ending = self._stopped = False
        self._sent = STOP
        self.account = ControllerState()

    @property
    def due_ns(self) -> int:
        """When the next tick should come, CLOCK_MONOTONIC; 0: at once."""
        return self._due_ns

    @property
    def stands(self) -> bool:
        """Whether the wheels were told to stand, or the controller hears nothing and stops them itself."""
        return self._sent == STOP or self.account.failed

    def see(self, pose: ControllerPose) -> None:
        """Takes a pose."""
        self._pose = pose

    def command(self, arrived: TimedSetpoint) -> None:
        """Takes a command."""
        self._command = arrived

    def stop(self, asked_ns: int) -> None:
        """Stops the wheels at the next tick, whatever had been commanded until then."""
        self._stop_ns = max(self._stop_ns, asked_ns)

    def end(self) -> None:
        """Stops the wheels for good."""
        self._ending = True

    def __call__(self) -> TickReport:
        """One tick."""
        now_ns = self._clock_ns()
        dt_s, late_s = self._rhythm(now_ns)
        pose, command = self._pose, self._command
        self._judge(self._situation(now_ns, late_s, pose, command), now_ns)
        drive, goal_rad = self._steered(now_ns, dt_s, pose, command)
        told = VelocityCommand(now_ns, drive.velocity_mps, goal_rad, drive.yaw_rate_radps)
        status = self._send(told, drive)
        if status is not None:
            self._heed(status, drive)
            sure = pose if self.account.reason in SURE else None
            self._goal.heard(status.heading_rad, sure.at(now_ns) if sure else None)
        done_ns = self._clock_ns()
        to_wheel_s = self._followed(pose, done_ns) if status is not None else math.nan
        return TickReport(None if status is None else told, late_s, (done_ns - now_ns) * NS, to_wheel_s, self.account)

    def close(self) -> None:
        """Stops the wheels at once and releases the driver."""
        self._driver.close()

    def _followed(self, pose: ControllerPose | None, done_ns: int) -> float:
        """How old the images of a pose are that is driven by for the first time, s; else NaN."""
        if pose is None or pose.stamp_ns <= self._driven_ns:
            return math.nan
        self._driven_ns = pose.stamp_ns
        return (done_ns - pose.stamp_ns) * NS

    def _rhythm(self, now_ns: int) -> tuple[float, float]:
        """Seconds since the last tick, and by how much this one comes later than in step with the earliest ones."""
        period_ns = round(self._settings.period_s * 1e9)
        dt_ns = now_ns - self._last_ns if self._last_ns else period_ns
        self._last_ns = now_ns
        due_ns = min(self._due_ns or now_ns, now_ns)
        missed = (now_ns - due_ns) // period_ns
        self._due_ns = due_ns + (1 + missed) * period_ns
        self.account.missed += missed
        return dt_ns * NS, (now_ns - due_ns) * NS

    def _situation(
        self, now_ns: int, late_s: float, pose: ControllerPose | None, command: TimedSetpoint | None
    ) -> SafetyInputs:
        valid = command is not None and command.arrival_ns > self._void_ns
        return SafetyInputs(
            pose_age_s=math.inf if pose is None else (now_ns - pose.stamp_ns) * NS,
            pose_state="" if pose is None else pose.state,
            command_age_s=(now_ns - command.arrival_ns) * NS if command is not None and valid else math.inf,
            late_s=late_s, motor_failed=self.account.failed, motor_stopped=self._stopped,
            stop_asked=self._stop_ns > self._void_ns, ending=self._ending)

    def _judge(self, situation: SafetyInputs, now_ns: int) -> None:
        """Notes why the wheels must stand, if they must; voids the commands so far, and counts what stopped a drive."""
        before, reason = self.account.reason, stop_reason(situation, self._settings.deadlines)
        self.account.reason = reason
        if not reason:
            return
        self._void_ns = now_ns
        if not before:
            self.account.stops[reason] += 1
            self._report(f"the wheels stop: {reason}")

    def _steered(
        self, now_ns: int, dt_s: float, pose: ControllerPose | None, command: TimedSetpoint | None
    ) -> tuple[Twist, float]:
        """The drive within the limits, and the controller's heading that it leads to."""
        if self.account.reason or pose is None or command is None:
            return self._settings.limits.step(STOP, self._sent, dt_s), self._goal.stay()
        heading_rad = pose.at(now_ns)
        wanted = self._hold.step(command.setpoint, heading_rad, dt_s, self._sent)
        drive = self._settings.limits.step(wanted, self._sent, dt_s)
        return drive, self._goal.towards(command.setpoint, heading_rad, drive.yaw_rate_radps * dt_s)

    def _send(self, command: VelocityCommand, drive: Twist) -> MotorStatus | None:
        """The controller's answer; None where it gave none."""
        try:
            status = self._driver.send(command)
        except LateReplyError:
            self._sent = drive  # it was told, and will have heard: the next step goes on from there
            self.account.late += 1
            return None
        except DriverError as error:
            if not self.account.failed:
                self._report(str(error))
            self.account.failed, self._sent = True, STOP  # its own watchdog stops a controller that hears nothing
            self.account.errors += 1
            return None
        if self.account.failed:
            self._report("the motor controller is back")
        self.account.failed = False
        self.account.sent += 1
        return status

    def _heed(self, status: MotorStatus, drive: Twist) -> None:
        """Takes to heart what the controller says: one that has stopped by itself did not obey."""
        self._stopped = status.watchdog_expired
        self.account.expiries += status.watchdog_expired
        self._sent = STOP if status.watchdog_expired else drive
        self.account.fault = status.fault
