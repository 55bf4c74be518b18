"""The one control law: from the newest pose and the newest setpoint to a motion within all limits.

It reads no clock: time is an argument. The controller process steps it on CLOCK_MONOTONIC, a replay on the stamps of
its log (omnid.stages.drive).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from omnid.core.control.heading_controller import HeadingController, HeadingLimits, Setpoint, Twist
from omnid.core.control.heading_goal import HeadingGoal
from omnid.core.control.safety_rules import COMMAND_STALE, IDLE, Deadlines, SafetyInputs, stop_reason
from omnid.core.control.velocity_limits import STOP, VelocityLimits
from omnid.settings import knob

S_PER_NS: Final = 1e-9
REASONS_WITH_GOOD_POSE: Final = ("", IDLE, COMMAND_STALE)  # the rules before these have accepted the pose


@dataclass(frozen=True, slots=True)
class ReplaySetpoint:
    """The setpoint of a replay, which has no operator; it is renewed all the time."""

    velocity_mps: float = knob(0.0, "replay: forward speed, m/s", low=-10, high=10)
    heading_deg: float = knob(0.0, "replay: heading in odom, counter-clockwise, deg", low=-360, high=360)

    def setpoint(self) -> Setpoint:
        """Return it in SI units."""
        return Setpoint(self.velocity_mps, math.radians(self.heading_deg))


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """Deadlines, limits and heading control of the base, the same in `omnid run` and in replays."""

    deadlines: Deadlines = field(default_factory=Deadlines)
    limits: VelocityLimits = field(default_factory=VelocityLimits)
    heading: HeadingLimits = field(default_factory=HeadingLimits)
    setpoint: ReplaySetpoint = field(default_factory=ReplaySetpoint)


class ControllerPose(NamedTuple):
    """The part of a pose that the controller needs."""

    stamp_ns: int  # of the capture
    heading_rad: float  # of the base in odom
    yaw_rate_radps: float
    state: str  # tracking | degraded | lost

    def heading_at(self, now_ns: int) -> float:
        """Return the heading at another time, at a constant yaw rate."""
        return self.heading_rad + self.yaw_rate_radps * (now_ns - self.stamp_ns) * S_PER_NS


class TimedSetpoint(NamedTuple):
    """A setpoint and the time of its arrival, by the clock that steps the law."""

    arrival_ns: int
    setpoint: Setpoint


class ControlOutput(NamedTuple):
    """The result of one step."""

    motion: Twist
    heading_rad: float  # for motor controllers that hold a heading themselves, in their own count
    reason: str  # why the wheels must stop; empty where they may turn


class ControlLaw:
    """Heading controller, velocity limits and safety rules, stepped by the caller.

    It stops, with the deceleration of the limits, for every reason in omnid.core.control.safety_rules. A stop voids
    all setpoints that arrived before it: only a later one moves the wheels again. Not thread-safe.
    """

    def __init__(self, settings: ControllerSettings, start_ns: int) -> None:
        """start_ns: setpoints that arrived until then are void."""
        self._settings = settings
        self._heading_controller, self._goal = HeadingController(settings.heading), HeadingGoal()
        self._void_ns = start_ns  # setpoints that arrived until then are void
        self._stop_ns = 0  # of the last request to stop
        self._ending = False
        self.pose: ControllerPose | None = None
        self.command: TimedSetpoint | None = None
        self.motion = STOP  # that the base follows now: the next step continues from it
        self.reason = IDLE  # of the last step

    def stop(self, asked_ns: int) -> None:
        """Stop the wheels at the next step; all setpoints that arrived until then are void."""
        self._stop_ns = max(self._stop_ns, asked_ns)

    def end(self) -> None:
        """Stop the wheels for good."""
        self._ending = True

    def step(self, now_ns: int, dt_s: float, *, late_s: float = 0.0, motor_failed: bool = False,
             motor_stopped: bool = False) -> ControlOutput:
        """Return the motion dt_s after the one that the base follows now, and take it for the one it follows next."""
        self.reason = stop_reason(self._inputs(now_ns, late_s, motor_failed, motor_stopped), self._settings.deadlines)
        if self.reason:
            self._void_ns = now_ns
        pose, command = self.pose, self.command
        if self.reason or pose is None or command is None:
            motion, heading_rad = self._settings.limits.step(STOP, self.motion, dt_s), self._goal.stay()
        else:
            measured_rad = pose.heading_at(now_ns)
            wanted = self._heading_controller.step(command.setpoint, measured_rad, dt_s, self.motion)
            motion = self._settings.limits.step(wanted, self.motion, dt_s)
            heading_rad = self._goal.towards(command.setpoint, measured_rad, motion.yaw_rate_radps * dt_s)
        self.motion = motion
        return ControlOutput(motion, heading_rad, self.reason)

    def motor_heading(self, counted_rad: float, now_ns: int) -> None:
        """Take the heading that the motor controller reported after a step, in its own count; NaN if it knows none."""
        good = self.pose if self.reason in REASONS_WITH_GOOD_POSE else None
        self._goal.update(counted_rad, good.heading_at(now_ns) if good else None)

    def _inputs(self, now_ns: int, late_s: float, motor_failed: bool, motor_stopped: bool) -> SafetyInputs:
        pose, command = self.pose, self.command
        valid = command is not None and command.arrival_ns > self._void_ns
        return SafetyInputs(
            pose_age_s=math.inf if pose is None else (now_ns - pose.stamp_ns) * S_PER_NS,
            pose_state="" if pose is None else pose.state,
            command_age_s=(now_ns - command.arrival_ns) * S_PER_NS if command is not None and valid else math.inf,
            late_s=late_s,
            motor_failed=motor_failed,
            motor_stopped=motor_stopped,
            stop_asked=self._stop_ns > self._void_ns,
            ending=self._ending,
        )
