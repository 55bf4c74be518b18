"""The one control law: from the newest pose and the newest setpoint to a motion within all limits.

It reads no clock: time is an argument. The controller process steps it on CLOCK_MONOTONIC.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Literal, NamedTuple, TypeAlias

from omnid.core.control import safety_rules
from omnid.core.control.arming import (
    MANUAL,
    NO_ANSWER,
    STARTED,
    ArmAnswer,
    Arming,
    ArmRequest,
    CommandSelector,
    Contacts,
    TimedSetpoint,
)
from omnid.core.control.collision_monitor import CollisionMonitor, CollisionSettings, ControllerScan
from omnid.core.control.heading_controller import (
    JUMP_RAD,
    LONGEST_TICK_S,
    STOP,
    HeadingGoal,
    Setpoint,
    Twist,
    VelocityLimits,
    towards,
    wrap_angle,
)
from omnid.core.control.motion_monitor import AGREE, Conflict, Motion, MotionSettings, Plausibility, TrustSettings
from omnid.core.control.safety_rules import FAULTS, Deadlines, stop_reason
from omnid.core.nanoseconds import S_PER_NS
from omnid.tracking_state import TrackingState

TO_STAND: Final = Setpoint()


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """Deadlines and limits of the base."""

    deadlines: Deadlines = field(default_factory=Deadlines)
    limits: VelocityLimits = field(default_factory=VelocityLimits)
    arming: Annotated[
        Literal["manual", "automatic"],
        "manual: the wheels turn only after cmd/arm (`omnid arm`), again after each stop and each "
        "fault; automatic: for service without an operator, faults that have passed need no cmd/arm, stops do",
    ] = MANUAL
    trust: TrustSettings = field(default_factory=TrustSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    collision: CollisionSettings = field(default_factory=CollisionSettings)

    @property
    def of_log(self) -> ControllerSettings:
        """The settings where the images are those of a log, which do not follow the wheels."""
        return replace(self, motion=replace(self.motion, check=False)).without_obstacles

    @property
    def without_obstacles(self) -> ControllerSettings:
        """The settings where no obstacles are looked for."""
        return replace(self, collision=replace(self.collision, check=False))


class ControllerPose(NamedTuple):
    """The part of a pose that the controller needs."""

    stamp_ns: int  # time of the capture
    heading_rad: float  # heading of the base in odom
    yaw_rate_radps: float
    state: str  # tracking | degraded | lost
    velocity_mps: float = math.nan  # forward; NaN if unknown
    velocity_sigma_mps: float = 0.0
    yaw_rate_sigma_radps: float = 0.0
    resets: int = 0  # how often odometry has lost its map and begun again
    conflict: Conflict = AGREE  # whether images, wheels and gyro show the same motion

    @property
    def motion(self) -> Motion:
        """The motion that was seen."""
        return Motion(self.velocity_mps, self.yaw_rate_radps, self.velocity_sigma_mps, self.yaw_rate_sigma_radps)

    def heading_at(self, now_ns: int) -> float:
        """Return the heading at another time, at a constant yaw rate."""
        return self.heading_rad + self.yaw_rate_radps * (now_ns - self.stamp_ns) * S_PER_NS


# What the daemon gives the controller; of each kind the newest counts.
ControlInput: TypeAlias = ControllerPose | ControllerScan | TimedSetpoint | ArmRequest


@dataclass(slots=True)
class ControllerState:
    """The state of the controller after a tick, and its counts since the start."""

    reason: str = safety_rules.IDLE  # why the wheels must stop now; empty: they may turn
    armed: bool = False
    disarmed_by: str = STARTED  # empty while armed
    needs_request: bool = False  # only cmd/arm lets the wheels turn again
    stop_count: int = 0  # stops and faults that have made cmd/arm necessary
    stopped_by: str = ""  # reason of the newest of them, kept after arming
    arm_answer: ArmAnswer = NO_ANSWER
    source: str = ""  # source of the commands that drive; empty while none does
    failed: bool = False  # the last command failed
    problem: str = ""  # why, in words
    fault: int = 0  # the motor controller's own number
    battery_v: float = math.nan  # voltage that the motor controller reports
    slowed_by: str = ""  # why the base drives slowly; empty: it need not
    measured: str = ""  # by how much the sensors of the motion differ; empty: they agree
    obstacle: str = ""  # why the collision monitor slows down or stops the base; empty: it does not
    blocked: bool = False  # the collision monitor stops the base: the command leads to an obstacle
    sent: int = 0  # commands that were answered
    late: int = 0  # commands whose answer did not come in time; the wheels keep turning
    errors: int = 0  # commands that failed
    expiries: int = 0  # how often the motor controller had stopped the wheels by itself
    missed: int = 0  # ticks that were left out
    refused: Counter[str] = field(default_factory=Counter)  # commands, by reason
    stops: Counter[str] = field(default_factory=Counter)  # stops of wheels that turned, by reason

    @property
    def blocked_by(self) -> str:
        """Why the collision monitor stops the base; empty: it does not."""
        return self.obstacle if self.blocked else ""

    @property
    def stopping_rule(self) -> str:
        """The safety rule that stops the wheels now; empty: none does, or only one for want of a command."""
        return "" if self.reason in (safety_rules.IDLE, safety_rules.COMMAND_STALE) else self.reason


class ControlOutput(NamedTuple):
    """The result of one step."""

    motion: Twist
    heading_rad: float  # heading in the count of a motor controller that holds one itself
    reason: str  # why the wheels must stop; empty where they may turn


class ControlLaw:
    """Heading controller, velocity limits and safety rules, stepped by the caller.

    It stops, with the deceleration of the limits, for every reason in omnid.core.control.safety_rules. Each of them
    voids all setpoints that arrived before it: only a later one moves the wheels again, and after a stop or a fault
    only while armed (omnid.core.control.arming). A heading is one in odom as it is when the setpoint arrives: a jump of
    the pose, when odometry closes a gap, voids it, since its sender has not seen the corrected pose. Not thread-safe.
    """

    def __init__(self, settings: ControllerSettings, start_ns: int) -> None:
        """start_ns: setpoints that arrived until then are void."""
        self._settings = settings
        self.goal = HeadingGoal(settings.limits)  # of a motor controller that holds headings
        self._void_ns = start_ns  # setpoints that arrived until then are void
        self._pose_jumped = False
        self.pose: ControllerPose | None = None  # the newest one
        self.ending = False  # True: the wheels stop until the process ends
        self.arming = Arming(settings.arming)
        self.plausibility = Plausibility(settings.trust, settings.motion)
        self.contacts = Contacts()
        self.commands = CommandSelector(settings.deadlines.command_s)
        limits = settings.limits
        self.collision = CollisionMonitor(settings.collision, limits.deceleration_mps2, limits.yaw_acceleration_radps2)
        self.motion = STOP  # motion of the base now, from which the next step continues
        self.reason = safety_rules.IDLE  # reason of the last step

    def take(self, given: ControlInput) -> None:
        """Take a pose, an obstacle scan, a setpoint, or a request to arm, which the next step answers."""
        if isinstance(given, ControllerPose):
            self._pose_jumped |= self.pose is not None and self._jumps(self.pose, given)
            self.pose = given
            self.plausibility.add_pose(given.stamp_ns, given.state, given.motion, given.resets, given.conflict)
        elif isinstance(given, ControllerScan):
            self.collision.set_scan(given)
        elif isinstance(given, TimedSetpoint):
            self.commands.offer(given)
        else:
            self.arming.request(given)

    def step(self, now_ns: int, dt_s: float, *, late_s: float = 0.0, motor: str = "") -> ControlOutput:
        """Return the motion that the base is to follow from now on; the previous one was commanded dt_s ago.

        late_s: lateness of this tick. motor: AWAITED, FAILED or STOPPED where that became of the last command.
        """
        # 1. Faults, from deadlines and from motion that does not fit together, disarm; requests to arm are answered.
        pose, command, deadlines = self.pose, self.commands.current, self._settings.deadlines
        pose_age_s = math.inf if pose is None else (now_ns - pose.stamp_ns) * S_PER_NS
        # A pose or a setpoint from the future by more than the deadline is a reason as well, and so is a NaN.
        conditions = {
            motor: True,
            safety_rules.OVERLOADED: not late_s <= deadlines.tick_s,
            safety_rules.NO_POSE: pose is None,
            safety_rules.POSE_STALE: pose is not None and not abs(pose_age_s) <= deadlines.pose_s,
            safety_rules.POSE_LOST: pose is not None and pose.state == TrackingState.LOST,
        }
        faults = {reason for reason, holds in conditions.items() if holds}
        faults |= self.contacts.take() | self.plausibility.take()
        accepted = self.arming.step(stop_reason(faults, FAULTS), now_ns, deadlines.command_s)
        if accepted is not None:
            self._void_ns = max(self._void_ns, accepted.arrival_ns)
        # 2. The reason to stop, of all rules; it voids the setpoints that have arrived so far.
        age_s = self._command_age_s(now_ns)
        conditions = {
            safety_rules.ENDS: self.ending,
            safety_rules.ASKED: self.arming.stop_asked,
            safety_rules.POSE_JUMPED: self._pose_jumped,
            safety_rules.NOT_ARMED: not self.arming.armed,
            safety_rules.IDLE: age_s == math.inf,
            safety_rules.COMMAND_STALE: not abs(age_s) <= deadlines.command_s,
        }
        self.reason = stop_reason(faults | {reason for reason, holds in conditions.items() if holds})
        self._pose_jumped = False
        if self.reason:
            self._void_ns = now_ns
        # 3. The motion: a ramp to rest, or towards the setpoint as far as trust and obstacles allow. The collision
        #    monitor comes last; what it allows is reached with the deceleration of the limits.
        limits = self._settings.limits
        if self.reason or pose is None or command is None:
            self.motion, goal_rad = limits.step(STOP, self.motion, dt_s), self.goal.stay()
        else:
            setpoint, heading_rad = command.setpoint, pose.heading_at(now_ns)
            wanted = self.plausibility.slowed(towards(setpoint, heading_rad, self.motion, limits), limits)
            is_heading = setpoint.heading_rad is not None
            allowed = self.collision.step(now_ns, limits.step(wanted, self.motion, dt_s), to_heading=is_heading)
            self.motion = limits.step(allowed, self.motion, dt_s)
            turn_rad = self.motion.yaw_rate_radps * min(max(dt_s, 0.0), LONGEST_TICK_S)
            error_rad = None if setpoint.heading_rad is None else wrap_angle(setpoint.heading_rad - heading_rad)
            goal_rad = self.goal.towards(turn_rad, error_rad)
        # 4. The collision monitor follows the motion, so that it knows where an older scan is now.
        self.collision.follow(now_ns, self.motion)
        return ControlOutput(self.motion, goal_rad, self.reason)

    def _jumps(self, before: ControllerPose, pose: ControllerPose) -> bool:
        """True if the heading has changed by more than the base can have turned since the last pose.

        That is: by more than it turns from rest, and by more than it turns with the yaw rate of the last pose.
        """
        limits, passed_s = self._settings.limits, abs(pose.stamp_ns - before.stamp_ns) * S_PER_NS
        turned_rad = abs(wrap_angle(pose.heading_rad - before.heading_rad))
        unpredicted_rad = abs(wrap_angle(pose.heading_rad - before.heading_at(pose.stamp_ns)))
        return (
            turned_rad > JUMP_RAD + limits.yaw_rate_radps * passed_s
            and unpredicted_rad > JUMP_RAD + limits.yaw_acceleration_radps2 * passed_s**2 / 2
        )

    def _command_age_s(self, now_ns: int) -> float:
        """Return the age of the setpoint; inf without a valid one, and for an old one of velocity zero.

        A sender that asked for velocity zero and is silent has finished: its command ends and is not stale.
        """
        command = self.commands.current
        if command is None or command.arrival_ns <= self._void_ns:
            return math.inf
        age_s = (now_ns - command.arrival_ns + command.age_ns) * S_PER_NS
        is_over = command.setpoint == TO_STAND and age_s > self._settings.deadlines.command_s
        return math.inf if is_over else age_s
