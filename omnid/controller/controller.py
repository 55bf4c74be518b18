"""The base controller: at a fixed rate, one step of the control law and one command to the motor controller."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from drivers.errors import DriverError
from drivers.motion import WheelSample
from drivers.motor import MotorDriver, MotorStatus, VelocityCommand
from drivers.motors.serial_motor import LateReplyError
from omnid.controller.statistics import ControllerState, TickReport
from omnid.core.control.arming import ArmRequest
from omnid.core.control.collision_monitor import remedy
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.contacts import BUS, MOTOR, ContactState
from omnid.core.control.control_law import ControlLaw, ControllerPose, ControllerSettings
from omnid.core.control.controller_ring import ControllerRing
from omnid.core.control.heading_controller import Twist
from omnid.core.control.motion_monitor import ADVICE, DISAGREEMENTS, WITNESSES, Motion
from omnid.core.control.plausibility import MOTION_DOUBTFUL, MotorReport
from omnid.core.control.safety_rules import ENDS, IDLE
from omnid.core.control.velocity_limits import STOP
from omnid.core.nanoseconds import S_PER_NS
from omnid.engine.flow import nothing

UNTIL_ARMED = "they stay stopped until cmd/arm (`omnid arm`)"


class Controller:
    """Take poses and setpoints, of which the newest count; each call is one tick.

    The law (omnid.core.control.control_law) decides; this class keeps the rhythm of the ticks, and reports to the law
    what became of its motions: an unanswered or failed command, a motor controller that had stopped by itself. Not
    thread-safe.
    """

    def __init__(
        self,
        driver: MotorDriver,
        settings: ControllerSettings,
        period_s: float,
        report: Callable[[str], None] = nothing,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        limited: Callable[[VelocityCommand], tuple[float, float]] | None = None,
    ) -> None:
        """report: takes lines for the log. clock_ns: the clock of the poses' stamps.

        limited: velocity [m/s] and yaw rate [rad/s] that the driver makes of a command; None: those of the command.
        """
        self._driver, self._report, self._clock_ns = driver, report, clock_ns
        self._limited = limited or _unlimited
        self._period_ns = round(period_s * 1e9)
        self._law = ControlLaw(settings, self._clock_ns())
        self._last_ns = self._due_ns = 0  # the last tick, and when the next one is due
        self._driven_ns = 0  # capture of the newest pose that a command has followed from
        self._motor_stopped = False  # True if the motor controller stopped by itself before the last tick
        self.state = ControllerState()

    @property
    def due_ns(self) -> int:
        """Time at which the next tick is due (CLOCK_MONOTONIC); 0: at once."""
        return self._due_ns

    @property
    def is_at_rest(self) -> bool:
        """True if the last command was the stop, or if the motor controller failed and stops the wheels by itself."""
        return self._law.motion == STOP or self.state.failed

    def set_pose(self, pose: ControllerPose) -> None:
        """Replace the pose."""
        self._law.set_pose(pose)

    def set_ring(self, ring: ControllerRing) -> None:
        """Replace the obstacle ring."""
        self._law.set_ring(ring)

    def set_command(self, command: TimedSetpoint) -> None:
        """Offer a setpoint; the newest of the source of the highest priority counts."""
        conflict = self._law.commands.conflict
        self._law.set_command(command)
        if self._law.commands.conflict != conflict:
            self._report(self._law.commands.conflict)

    def stop(self, asked_ns: int) -> None:
        """Stop the wheels at the next tick, until a request to arm that arrives later."""
        self._law.stop(asked_ns)

    def touch(self, contacts: ContactState) -> None:
        """Replace the state of bumpers and cliff sensors on the bus."""
        self._law.contacts.update(BUS, contacts)

    def arm(self, request: ArmRequest) -> None:
        """Ask to arm: the wheels may turn from the next tick on, by setpoints that arrive later."""
        self._law.arm(request)

    def end(self) -> None:
        """Stop the wheels permanently."""
        self._law.end()

    def tick(self) -> TickReport:
        """Step the law and send its motion."""
        # 1. Step the law.
        now_ns = self._clock_ns()
        dt_s, late_s = self._keep_rhythm(now_ns)
        output = self._law.step(
            now_ns, dt_s, late_s=late_s, motor_failed=self.state.failed, motor_stopped=self._motor_stopped
        )
        # 2. Keep its state for the status, and report what has changed.
        self._report_arming()
        self._report_slowing()
        self._report_obstacles()
        self._count_stop(output.reason)
        # 3. Send its motion, and report to the law whether it was sent.
        command = VelocityCommand(now_ns, output.motion.velocity_mps, output.heading_rad, output.motion.yaw_rate_radps)
        status = self._send(command)
        self._law.plausibility.add_command(now_ns, STOP if self.state.failed else Twist(*self._limited(command)))
        if status is not None:
            self._take_status(status, now_ns)
        # 4. Report times, and the motion that the wheels have measured.
        done_ns = self._clock_ns()
        to_wheel_s = self._to_wheel_s(done_ns) if status is not None else math.nan
        is_known = status is not None and math.isfinite(status.velocity_mps)
        wheels = WheelSample(now_ns, status.velocity_mps, status.yaw_rate_radps) if status and is_known else None
        return TickReport(
            None if status is None else command, late_s, (done_ns - now_ns) * S_PER_NS, to_wheel_s, self.state, wheels
        )

    def close(self) -> None:
        """Stop the wheels at once and release the driver."""
        self._driver.close()

    def _keep_rhythm(self, now_ns: int) -> tuple[float, float]:
        """Return the seconds since the last tick, and the lateness of this one against the rhythm of the earliest."""
        dt_ns = now_ns - self._last_ns if self._last_ns else self._period_ns
        self._last_ns = now_ns
        due_ns = min(self._due_ns or now_ns, now_ns)
        missed = (now_ns - due_ns) // self._period_ns
        self._due_ns = due_ns + (1 + missed) * self._period_ns
        self.state.missed += missed
        return dt_ns * S_PER_NS, (now_ns - due_ns) * S_PER_NS

    def _report_arming(self) -> None:
        """Keep the state of the arming and of the sources; report each arming, and refusals when the reason changes."""
        state, arming, commands = self.state, self._law.arming, self._law.commands
        before, answer = state.arm_answer, arming.answer
        if answer != before and (not answer.refusal or answer.refusal != before.refusal):
            self._report(f"arming is refused: {answer.refusal}" if answer.refusal else "armed by cmd/arm")
        # `_count_stop` reports the end of a drive; a fault that comes while the wheels are at rest ends none.
        if state.armed and arming.needs_request and state.reason:
            self._report(f"disarmed while the wheels stand: {arming.reason}; {UNTIL_ARMED}")
        state.armed, state.disarmed_by, state.arm_answer = arming.armed, arming.reason, answer
        state.needs_request = arming.needs_request
        state.halts, state.halted_by = arming.halts, arming.halted_by
        state.refused = commands.refused
        state.source = "" if self._law.reason or commands.current is None else commands.current.source

    def _report_slowing(self) -> None:
        """Keep the reason to drive slowly; report the start of one that a person should examine."""
        before, self.state.slowed_by = self.state.slowed_by, self._law.plausibility.slowed_by
        self.state.slowed += bool(self.state.slowed_by and not before)
        slowed_by = self.state.slowed_by
        if slowed_by in (MOTION_DOUBTFUL, *WITNESSES) and slowed_by != before:
            self._report(f"the wheels turn slowly: {slowed_by}{self._detail(slowed_by)}")

    def _report_obstacles(self) -> None:
        """Keep the collision monitor's reason to slow down or stop; count and report the stops."""
        state, monitor = self.state, self._law.collision
        was_blocked = state.blocked
        state.obstacle = "" if self._law.reason else monitor.reason
        state.blocked = bool(state.obstacle) and monitor.share == 0.0
        if state.blocked and not was_blocked:
            state.obstacle_stops += 1
            self._report(f"the wheels stop: {state.obstacle}; {remedy(state.obstacle)}")

    def _count_stop(self, reason: str) -> None:
        """Keep the reason; count it where it cuts a drive short, and report it unless the end was asked for."""
        before, self.state.reason = self.state.reason, reason
        if reason not in ("", IDLE) and not before:
            self.state.stops[reason] += 1
            if reason != ENDS:
                latched = f"; {UNTIL_ARMED}" if self._law.arming.needs_request else ""
                advice = f"; {ADVICE}" if reason in DISAGREEMENTS else ""
                self._report(f"the wheels stop: {reason}{self._detail(reason)}{advice}{latched}")

    def _detail(self, reason: str) -> str:
        """Return by how much images, wheels and gyro differ, where that is the reason."""
        witness = self._law.plausibility.witness
        return f" {witness.detail}" if witness.reason == reason and witness.detail else ""

    def _send(self, command: VelocityCommand) -> MotorStatus | None:
        """Send the command; return the motor controller's answer, None where it gave none."""
        try:
            status = self._driver.send(command)
        except LateReplyError:  # The command was most likely received, so the law continues from its motion.
            self.state.late += 1
            return None
        except DriverError as error:
            if not self.state.failed:
                self._report(str(error))
            self.state.failed = True
            self.state.errors += 1
            self._law.stand()  # its own watchdog stops a motor controller that receives nothing
            return None
        if self.state.failed:
            self._report("the motor controller is back")
        self.state.failed = False
        self.state.sent += 1
        return status

    def _take_status(self, status: MotorStatus, now_ns: int) -> None:
        self._motor_stopped = status.watchdog_expired
        self.state.expiries += status.watchdog_expired
        self.state.fault, self.state.battery_v = status.fault, status.battery_v
        self._law.contacts.update(MOTOR, ContactState(status.bumper, status.cliff))
        if status.watchdog_expired:  # the base is at rest: the command was not obeyed
            self._law.stand()
        self._law.motor_heading(status.heading_rad, status.yaw_rate_radps)
        # A motor controller that holds a heading chooses the yaw rate itself, so it cannot contradict the command.
        yaw_rate_radps = math.nan if math.isfinite(status.heading_rad) else status.yaw_rate_radps
        self._law.plausibility.add_report(
            now_ns, MotorReport(Motion(status.velocity_mps, yaw_rate_radps), status.fault, status.battery_v)
        )

    def _to_wheel_s(self, done_ns: int) -> float:
        """Return the age of the pose's images where this command is the first that follows from them, else NaN."""
        pose = self._law.pose
        if pose is None or pose.stamp_ns <= self._driven_ns:
            return math.nan
        self._driven_ns = pose.stamp_ns
        return (done_ns - pose.stamp_ns) * S_PER_NS


def _unlimited(command: VelocityCommand) -> tuple[float, float]:
    return command.velocity_mps, command.yaw_rate_radps
