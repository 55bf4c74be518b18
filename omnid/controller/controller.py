"""The base controller: at a fixed rate, one step of the control law and one command to the motor controller."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from copy import copy

from drivers.errors import DriverError
from drivers.motion import WheelSample
from drivers.motor import MotorDriver, MotorStatus, VelocityCommand
from drivers.motors.serial_motor import LateReplyError
from omnid.controller.ipc import TickReport, cuts_drive_short, transitions
from omnid.core.control.arming import BUS, MOTOR, ContactState
from omnid.core.control.control_law import ControlInput, ControlLaw, ControllerSettings, ControllerState
from omnid.core.control.heading_controller import STOP, Twist
from omnid.core.control.motion_monitor import Motion
from omnid.core.control.safety_rules import AWAITED, BUMPER, CLIFF, FAILED, STOPPED
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS


class Controller:
    """Runs the control law on the newest pose and setpoint; each call of `tick` is one tick.

    The law (omnid.core.control.control_law) decides; this class keeps the rhythm of the ticks, and reports to the law
    what became of its commands: unanswered, failed, or the motor controller had stopped by itself. Not thread-safe.
    """

    def __init__(
        self,
        driver: MotorDriver,
        settings: ControllerSettings,
        period_s: float,
        report: Callable[[str], None] = lambda line: None,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        limited: Callable[[VelocityCommand], tuple[float, float]] | None = None,
        is_awaited: bool = False,
    ) -> None:
        """report: takes lines for the log. clock_ns: the clock of the poses' stamps.

        is_awaited: the motor controller has not answered yet.

        limited: velocity [m/s] and yaw rate [rad/s] that the driver makes of a command; None: those of the command.
        """
        self._driver, self._report, self._clock_ns = driver, report, clock_ns
        self._limited = limited or (lambda command: (command.velocity_mps, command.yaw_rate_radps))
        self._period_ns = round(period_s * NS_PER_S)
        self._law = ControlLaw(settings, self._clock_ns())
        self._last_ns = 0  # the last tick
        self.due_ns = 0  # when the next one is due (CLOCK_MONOTONIC); 0: at once
        self._motor_stopped = False  # True if the motor controller stopped by itself before the last tick
        self.state = ControllerState(failed=is_awaited)

    @property
    def is_at_rest(self) -> bool:
        """True if the last command was the stop, or if the motor controller failed and stops the wheels by itself."""
        return self._law.motion == STOP or self.state.failed

    def take(self, given: ControlInput) -> None:
        """Pass a pose, an obstacle scan, a setpoint or a request to arm to the law."""
        conflict = self._law.commands.conflict
        self._law.take(given)
        if self._law.commands.conflict != conflict:
            self._report(self._law.commands.conflict)

    def stop(self, asked_ns: int) -> None:
        """Stop the wheels at the next tick, until a request to arm that arrives later."""
        self._law.arming.stop(asked_ns)

    def touch(self, contacts: ContactState) -> None:
        """Replace the state of bumpers and cliff sensors on the bus."""
        self._law.contacts.update(BUS, contacts)

    def end(self) -> None:
        """Stop the wheels permanently."""
        self._law.ending = True

    def tick(self) -> TickReport:
        """Step the law, and send its motion."""
        before, law = self.state, self._law
        self.state = state = copy(before)  # a state that was reported does not change
        # 1. Keep the rhythm of the earliest tick; ticks whose time has passed are left out.
        now_ns = self._clock_ns()
        dt_ns = now_ns - self._last_ns if self._last_ns else self._period_ns
        due_ns = min(self.due_ns or now_ns, now_ns)
        missed = (now_ns - due_ns) // self._period_ns
        self._last_ns, self.due_ns = now_ns, due_ns + (1 + missed) * self._period_ns
        state.missed += missed
        # 2. Step the law, which is told what became of the last command; keep and report what has changed.
        motor, late_s = STOPPED if self._motor_stopped else "", (now_ns - due_ns) * S_PER_NS
        if state.failed:
            motor = FAILED if state.sent else AWAITED
        output = law.step(now_ns, dt_ns * S_PER_NS, late_s=late_s, motor=motor)
        self._keep_state(before, output.reason)
        # 3. Send its motion, and report to the law what became of it.
        command = VelocityCommand(now_ns, output.motion.velocity_mps, output.heading_rad, output.motion.yaw_rate_radps)
        status = self._send(command)
        law.plausibility.add_command(now_ns, STOP if state.failed else Twist(*self._limited(command)))
        wheels = None
        if status is not None:
            self._take_status(status, now_ns)
            if math.isfinite(status.velocity_mps):
                wheels = WheelSample(now_ns, status.velocity_mps, status.yaw_rate_radps)
        work_s = (self._clock_ns() - now_ns) * S_PER_NS
        return TickReport(None if status is None else command, late_s, work_s, state, wheels)

    def close(self) -> None:
        """Stop the wheels at once and release the driver."""
        self._driver.close()

    def _keep_state(self, before: ControllerState, reason: str) -> None:
        """Keep what the law has decided, for the status; count and report what has changed since the last tick."""
        state, law = self.state, self._law
        state.reason = reason
        arming, commands, monitor = law.arming, law.commands, law.collision
        state.armed, state.disarmed_by, state.arm_answer = arming.armed, arming.reason, arming.answer
        state.needs_request, state.refused = arming.needs_request, commands.refused
        state.stop_count, state.stopped_by = arming.stop_count, arming.stopped_by
        state.source = "" if law.reason or commands.current is None else commands.current.source
        state.slowed_by = law.plausibility.slowed_by
        state.measured = law.plausibility.conflict.detail
        state.obstacle = "" if law.reason else monitor.reason
        state.blocked = bool(state.obstacle) and monitor.holds
        if cuts_drive_short(before, state):
            state.stops[reason] += 1
        for line in transitions(before, state, law.plausibility.conflict):
            self._report(line)

    def _send(self, command: VelocityCommand) -> MotorStatus | None:
        """Send the command; return the motor controller's answer, None where it gave none."""
        state = self.state
        try:
            status = self._driver.send(command)
        except LateReplyError:  # The command was most likely received, so the law continues from its motion.
            state.late += 1
            return None
        except DriverError as error:
            problem = str(error)
            if problem != state.problem:
                self._report(problem if state.sent else f"{AWAITED}: {problem}")
            state.failed, state.problem, state.errors = True, problem, state.errors + 1
            self._law.motion = STOP  # its own watchdog stops a motor controller that receives nothing
            return None
        if state.problem:
            self._report("the motor controller is back" if state.sent else "the motor controller answers")
        state.failed, state.problem = False, ""
        state.sent += 1
        return status

    def _take_status(self, status: MotorStatus, now_ns: int) -> None:
        self._motor_stopped = status.watchdog_expired
        self.state.expiries += status.watchdog_expired
        self.state.fault, self.state.battery_v = status.fault, status.battery_v
        holding = {contact for contact, holds in ((BUMPER, status.bumper), (CLIFF, status.cliff)) if holds}
        self._law.contacts.update(MOTOR, ContactState(frozenset(holding)))
        if status.watchdog_expired:  # the base is at rest: the command was not obeyed
            self._law.motion = STOP
        self._law.goal.update(status.heading_rad)
        # A motor controller that holds a heading chooses the yaw rate itself, so it cannot contradict the command.
        yaw_rate_radps = math.nan if math.isfinite(status.heading_rad) else status.yaw_rate_radps
        motion = Motion(status.velocity_mps, yaw_rate_radps)
        self._law.plausibility.add_report(now_ns, motion, status.fault, status.battery_v)
