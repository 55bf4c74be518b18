"""A stateful property test: random events against the controller, and an oracle that states what may move the wheels.

The oracle knows the events only. It says when motion is permitted; the controller may be stricter, never laxer.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import dataclass, field, replace

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.serial_motor import LateReplyError
from omnid.controller.controller import Controller
from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC, MANUAL, NO_CONTACT, OPERATOR, ArmRequest, TimedSetpoint
from omnid.core.control.collision_monitor import (
    BLOCKED,
    MOVING,
    NEAR,
    SCAN_STALE,
    UNKNOWN,
    CollisionSettings,
    ControllerScan,
    MovingPoint,
)
from omnid.core.control.control_law import ControllerPose
from omnid.core.control.heading_controller import LONGEST_TICK_S, STOP, Setpoint, Twist, wrap_angle
from omnid.core.control.motion_monitor import AGREE, CONFLICTS, Conflict
from omnid.core.control.safety_rules import BUMPER, CLIFF
from tests.omnid.controller.bench import LIMITS, PERIOD_NS, PERIOD_S, SETTINGS

TICKS = 6_000
PHASE = 40  # ticks with the same motor, images and calm
MANY_TICKS = 1_000_000
DEADLINES = SETTINGS.deadlines
HOLD_NS = round(SETTINGS.deadlines.command_s * 1e9)
# The angle that it turns at the highest rate within 0.15 s, and then until it has braked.
LEAD_RAD = LIMITS.yaw_rate_radps * 0.15 + LIMITS.yaw_rate_radps**2 / (2 * LIMITS.yaw_acceleration_radps2)
SENDERS = (("operator", "a"), ("operator", "a"), ("operator", "b"), ("planner", "c"))
TINY = 1e-9
FAULTS = frozenset(safety_rules.FAULTS)
COLLISION = CollisionSettings()
SCANS = ("free", "free", "free", "ahead", "behind", "unknown", "random", "person", "none")
SLOW_SHARE = SETTINGS.trust.degraded_speed
# Of some phases, what the motor controller reports and the poses show: its fault, volts, the speed of the wheels (None:
# as commanded), the speed that is seen (NaN: unknown) and its standard deviation.
USUAL = (0, 12.0, None, math.nan, 0.0)
ODDITIES = (
    (7, 12.0, None, math.nan, 0.0),
    (0, 10.0, None, math.nan, 0.0),
    (0, 12.0, 2.0, math.nan, 0.0),
    (0, 12.0, None, 0.0, 0.0),
    (0, 12.0, None, 1.5, 0.0),
    (0, 12.0, None, math.nan, 1.0),
)
AWAITED_TICKS = 50  # before the motor controller answers for the first time


class RandomMotor:
    """A motor driver that fails, is late or has stopped by itself, as the test sets it for the next command."""

    def __init__(self) -> None:
        self.fault = ""  # "", "silent", "late", "expired"
        self.number, self.battery_v = 0, 12.0
        self.wheels_mps: float | None = None  # as commanded
        self.counted_rad = self.rate_radps = 0.0
        self.sent: VelocityCommand | None = None

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Keep the command; answer, or not."""
        self.sent = command
        if self.fault == "silent":
            raise DriverError("no answer")
        if self.fault == "late":
            raise LateReplyError("no answer yet")
        velocity_mps = command.velocity_mps if self.wheels_mps is None else self.wheels_mps
        return MotorStatus(
            velocity_mps, self.counted_rad, self.rate_radps, self.fault == "expired", self.number, self.battery_v
        )

    def close(self) -> None:
        """Release nothing."""


@dataclass
class Oracle:
    """The permission to move, from the events alone."""

    automatic: bool
    armed: bool = False
    armed_ns: int = 0  # arrival of the request that armed
    stop_ns: int = 0
    stop_latched: bool = False
    fault_ns: int = 0  # of the last tick with a fault
    failed: bool = False  # the motor controller, at the last tick
    stopped: bool = False
    contact: bool = False  # a bumper or a cliff sensor reports one
    pose: ControllerPose | None = None
    scan: ControllerScan | None = None
    requests: list[ArmRequest] = field(default_factory=list)  # since the last tick
    current: TimedSetpoint | None = None  # of the source and the sender that own the wheels

    def take_stop(self, asked_ns: int) -> None:
        """Take a stop."""
        if asked_ns > self.stop_ns:
            self.stop_ns = asked_ns
            self.stop_latched = self.stop_latched or asked_ns > self.armed_ns

    def blocked(self, now_ns: int, ahead: bool) -> bool:
        """True if the newest scan is too old, or was taken just now and has an obstacle at the base on that side."""
        age_s = math.inf if self.scan is None else abs(now_ns - self.scan.stamp_ns) * 1e-9
        if self.scan is None or age_s > COLLISION.stale_s:
            return True
        edge_m = COLLISION.front_m if ahead else COLLISION.rear_m
        middle = self.scan.ranges_m[180 if ahead else 0]  # within half a degree of the axis
        # While the scan came the base can have moved by 0.4 m/s.
        return edge_m < middle < edge_m + COLLISION.stop_m - 0.4 * age_s

    def take_command(self, command: TimedSetpoint) -> None:
        """Take a command if its sender may drive: the first on its source, and none of higher priority before it."""
        now = self.current
        live = now is not None and command.arrival_ns - now.arrival_ns <= HOLD_NS
        if now is None or not live:
            permitted = True
        elif command.source == now.source:
            permitted = command.sender == now.sender
        else:
            permitted = command.source == OPERATOR
        if permitted and (now is None or command.arrival_ns >= now.arrival_ns):
            self.current = command

    def fault(self, now_ns: int, late_s: float) -> bool:
        """True if a fault holds at a tick."""
        pose = self.pose
        return (
            self.contact
            or self.failed
            or self.stopped
            or late_s > DEADLINES.tick_s
            or pose is None
            or pose.state == "lost"
            or pose.conflict.is_fault
            or abs(now_ns - pose.stamp_ns) * 1e-9 > DEADLINES.pose_s
        )

    def step(self, now_ns: int, late_s: float) -> TimedSetpoint | None:
        """Return the command that may move the wheels at a tick; None where they may only slow down."""
        fault = self.fault(now_ns, late_s)
        if fault:
            self.fault_ns = now_ns
        self.stop_latched |= self.contact
        self.armed = (self.automatic or self.armed) and not fault and not self.stop_latched
        for request in self.requests:
            age_s = (now_ns - request.arrival_ns) * 1e-9
            if not fault and request.arrival_ns > self.stop_ns and age_s <= DEADLINES.command_s:
                self.armed, self.armed_ns, self.stop_latched = True, max(self.armed_ns, request.arrival_ns), False
        self.requests.clear()
        command = self.current
        if not self.armed or command is None:
            return None
        younger = command.arrival_ns > max(self.armed_ns, self.stop_ns, self.fault_ns)
        return command if younger and (now_ns - command.arrival_ns) * 1e-9 <= DEADLINES.command_s else None


class Walk:
    """A controller, its random events, and the oracle."""

    def __init__(self, seed: int, mode: str) -> None:
        self.rng, self.now_ns = random.Random(seed), 10**12
        self.motor, self.oracle = RandomMotor(), Oracle(mode == AUTOMATIC)
        settings = replace(SETTINGS, arming=mode, collision=COLLISION)
        self.scans = "free"  # kind of the scans of a phase
        self.controller = Controller(self.motor, settings, PERIOD_S, clock_ns=lambda: self.now_ns)
        self.motion, self.last_ns = STOP, self.now_ns  # that the base follows, and since when
        self.calm, self.quiet = True, False  # phases with few faults and with many, without commands
        self.seen_mps, self.sigma_mps, self.resets, self.steady = math.nan, 0.0, 0, False
        self.contacts, self.conflict = NO_CONTACT, AGREE
        self.main = SENDERS[0]  # source and sender of most commands of a phase
        self.heading_rad = self.reported_rad = 0.0  # in odom; in the count of the motor controller
        self.seen: Counter[str] = Counter()

    def run(self, ticks: int) -> Counter[str]:
        """Return the number of ticks by reason."""
        rng = self.rng
        for tick in range(ticks):
            if tick % PHASE == 0:
                self.calm = self.rng.random() < 0.7
                usual, self.steady = self.chance(0.7, 0.4), rng.random() < 0.5
                oddity, self.conflict = USUAL if usual else rng.choice(ODDITIES), AGREE
                if usual and rng.random() < 0.4:
                    self.conflict = Conflict(rng.choice(CONFLICTS), "", rng.random() < 0.7)
                self.motor.number, self.motor.battery_v, self.motor.wheels_mps, self.seen_mps, self.sigma_mps = oddity
            if tick % 25 == 0:
                self.scans = self.rng.choice(SCANS)
                self.quiet, self.main = self.rng.random() < 0.1, self.rng.choice(SENDERS)
            self.events()
            if tick < AWAITED_TICKS:
                self.motor.fault = "silent"
            self.tick()
        return self.seen

    def chance(self, in_calm: float, else_: float) -> bool:
        """Return True with a probability that depends on the phase."""
        return self.rng.random() < (in_calm if self.calm else else_)

    def events(self) -> None:
        """Let random events happen, some of them with an older arrival than what has come before."""
        rng, oracle, controller = self.rng, self.oracle, self.controller
        self.now_ns += rng.randrange(1, 1000)
        if self.chance(0.95, 0.7):
            self.send_pose()
        if self.scans != "none" and self.chance(0.95, 0.7):
            self.send_scan()
        for _ in range(0 if self.quiet else rng.choice((0, 1, 1, 1, 2, 3))):
            self.send_command()
        if self.chance(0.01, 0.03):
            asked_ns = self.delayed_ns()
            oracle.take_stop(asked_ns)
            controller.stop(asked_ns)
        holding = bool(self.contacts.holding)
        if self.chance(0.3, 0.3) if holding else self.chance(0.001, 0.005):
            self.touch(rng.choice((BUMPER, CLIFF)), holds=not holding)
        while self.chance(0.06, 0.1):
            request = ArmRequest(self.delayed_ns(), self.now_ns)
            oracle.requests[:] = [request]  # the newest that was handed over counts
            controller.take(request)
        self.motor.fault = rng.choice(("silent", "late", "late", "expired")) if self.chance(0.004, 0.06) else ""
        self.motor.counted_rad = rng.uniform(-math.pi, math.pi) if self.chance(0.01, 0.1) else self.motor.counted_rad
        self.motor.rate_radps = rng.choice((0.0, 0.0, 0.5, -0.5, 3.0, -3.0, math.nan))

    def touch(self, contact: str, *, holds: bool) -> None:
        """Report the beginning of a contact, or the end of all."""
        for name in (contact,) if holds else (BUMPER, CLIFF):
            self.contacts = self.contacts.after(name, holds=holds)
        self.oracle.contact = holds
        self.controller.touch(self.contacts)

    def delayed_ns(self) -> int:
        """Return the arrival of a message that is handed over now, mostly a moment ago."""
        self.now_ns += 1
        delay_s = self.rng.choice((0.0, 0.0, 0.0, 0.0, self.rng.uniform(0, 0.2), self.rng.uniform(0, 2)))
        return self.now_ns - round(delay_s * 1e9)

    def send_pose(self) -> None:
        rng = self.rng
        self.heading_rad += rng.uniform(-0.05, 0.05) if self.chance(0.998, 0.95) else rng.uniform(-3, 3)
        state = "lost" if self.chance(0.002, 0.05) else rng.choice(("tracking", "tracking", "degraded"))
        age_s = rng.uniform(0.0, 0.15) if self.chance(0.999, 0.95) else rng.uniform(-1, 1)
        self.resets += not self.chance(0.9995, 0.99)
        pose = ControllerPose(
            self.now_ns - round(age_s * 1e9),
            wrap_angle(self.heading_rad),
            rng.uniform(-0.5, 0.5),
            state,
            self.seen_mps,
            self.sigma_mps,
            resets=self.resets,
            conflict=self.conflict,
        )
        self.oracle.pose = pose
        self.controller.take(pose)

    def send_scan(self) -> None:
        """Send an obstacle scan of the phase, some of them late."""
        rng, kind = self.rng, self.scans
        ranges = [math.inf] * 360
        if kind in ("ahead", "behind"):
            middle, nearest_m = 180 if kind == "ahead" else 0, rng.uniform(0.27, 1.2)
            for k in range(middle - 5, middle + 6):
                ranges[k] = rng.uniform(nearest_m, 1.2)
        if kind == "unknown":
            first = rng.randrange(200)
            ranges[first : first + 100] = [math.nan] * 100
        if kind == "random":
            ranges = [rng.choice((math.inf, math.nan, rng.uniform(0.1, 3.0))) for _ in range(360)]
        moving = (MovingPoint(rng.uniform(0.4, 2), rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-1, 1), 0.2),)
        age_s = rng.uniform(0.0, 0.15) if self.chance(0.99, 0.9) else rng.uniform(-1, 2)
        scan = ControllerScan(
            self.now_ns - round(age_s * 1e9),
            tuple(ranges),
            (rng.uniform(0, 2),) * 360,
            moving if kind == "person" else (),
        )
        if self.oracle.scan is None or scan.stamp_ns >= self.oracle.scan.stamp_ns:
            self.oracle.scan = scan
        self.controller.take(scan)

    def send_command(self) -> None:
        rng = self.rng
        velocity_mps = rng.uniform(-3, 3) if self.chance(1.0, 0.95) else rng.choice((math.nan, math.inf))
        velocity_mps = 3.0 if self.steady and self.calm else velocity_mps
        heading_rad = rng.choice((None, None, rng.uniform(-9, 9), math.nan if not self.calm else 0.0))
        source, sender = self.main if self.chance(0.98, 0.5) else rng.choice(SENDERS)
        setpoint = Setpoint(velocity_mps, heading_rad, rng.uniform(-5, 5))
        command = TimedSetpoint(self.delayed_ns(), setpoint, source, sender)
        self.oracle.take_command(command)
        self.controller.take(command)

    def tick(self) -> None:
        """Tick, and hold the result against the oracle."""
        late_s = 0.0 if not self.chance(0.003, 0.05) else self.rng.choice((0.1, 0.3, 1.0))
        self.now_ns = max(self.now_ns + 1, self.controller.due_ns or self.now_ns + PERIOD_NS) + round(late_s * 1e9)
        measured_late_s = (self.now_ns - (self.controller.due_ns or self.now_ns)) * 1e-9
        permitted = self.oracle.step(self.now_ns, measured_late_s)
        self.controller.tick()
        state, sent = self.controller.state, self.motor.sent
        self.seen[state.reason] += 1
        assert sent is not None
        now = Twist(sent.velocity_mps, sent.yaw_rate_radps)
        self.expect_limits(now, sent.heading_rad)
        assert not state.armed or self.oracle.armed, "armed without a request, or after a stop or a fault"
        assert not (state.armed and state.reason in FAULTS), "every fault disarms"
        if permitted is None:
            assert nearer(self.motion.velocity_mps, now.velocity_mps), (self.motion, now, state)
            assert nearer(self.motion.yaw_rate_radps, now.yaw_rate_radps), (self.motion, now, state)
        else:
            self.expect_obeys(
                permitted.setpoint,
                now,
                state.reason,
                SLOW_SHARE if state.slowed_by else 1.0,
                limited=bool(state.obstacle),
            )
        self.seen[state.obstacle] += bool(state.obstacle)
        if abs(now.yaw_rate_radps) < TINY and abs(self.motion.yaw_rate_radps) < TINY and now != STOP:
            assert not self.oracle.blocked(self.now_ns, now.velocity_mps > 0) or nearer(
                self.motion.velocity_mps, now.velocity_mps
            ), (self.motion, now, state, self.oracle.scan)
        if now != STOP and permitted:
            self.seen["driven"] += 1
            self.seen[f"driven by {permitted.source}"] += 1
        self.oracle.armed = state.armed  # it may be stricter than the oracle
        self.after(now)

    def after(self, now: Twist) -> None:
        """Note what the motor controller has made of the command."""
        fault = self.motor.fault
        self.motion = STOP if fault in ("silent", "expired") else now
        self.last_ns = self.now_ns
        if fault in ("", "expired"):
            self.reported_rad = self.motor.counted_rad
        if fault != "late":
            self.oracle.failed = fault == "silent"
            self.oracle.stopped = fault == "expired" if fault != "silent" else self.oracle.stopped

    def expect_limits(self, now: Twist, goal_rad: float) -> None:
        dt_s = min(LONGEST_TICK_S, max((self.now_ns - self.last_ns) * 1e-9, PERIOD_S)) + 1e-6
        before = self.motion
        assert all(map(math.isfinite, (now.velocity_mps, now.yaw_rate_radps, goal_rad)))
        assert abs(now.velocity_mps) <= LIMITS.velocity_mps and abs(now.yaw_rate_radps) <= LIMITS.yaw_rate_radps
        assert abs(now.yaw_rate_radps - before.yaw_rate_radps) <= LIMITS.yaw_acceleration_radps2 * dt_s + TINY
        assert abs(now.velocity_mps - before.velocity_mps) <= LIMITS.deceleration_mps2 * dt_s + TINY
        gained_mps = abs(now.velocity_mps) - abs(before.velocity_mps)
        assert gained_mps <= LIMITS.acceleration_mps2 * dt_s + TINY
        assert abs(wrap_angle(goal_rad - self.reported_rad)) <= LEAD_RAD + TINY

    def expect_obeys(self, setpoint: Setpoint, now: Twist, reason: str, share: float, *, limited: bool) -> None:
        """Expect a motion on the way to the owner's setpoint, or to a stop where the controller is stricter.

        share: of the limits, while it drives slowly. limited: by obstacles, at any speed down to a stop.
        """
        top_mps, top_radps = share * LIMITS.velocity_mps, share * LIMITS.yaw_rate_radps
        heading_rad = setpoint.heading_rad
        valid = math.isfinite(setpoint.velocity_mps) and (heading_rad is None or math.isfinite(heading_rad))
        wanted_mps = max(-top_mps, min(top_mps, setpoint.velocity_mps)) if valid else 0.0
        wanted_mps = 0.0 if reason else wanted_mps
        stop = (0.0,) if limited else ()
        low_mps, *_, high_mps = sorted((self.motion.velocity_mps, wanted_mps, *stop))
        assert low_mps - TINY <= now.velocity_mps <= high_mps + TINY, (self.motion, setpoint, now, reason)
        if heading_rad is None and valid and not reason:
            wanted_radps = max(-top_radps, min(top_radps, setpoint.yaw_rate_radps))
            low_radps, *_, high_radps = sorted((self.motion.yaw_rate_radps, wanted_radps, *stop))
            assert low_radps - TINY <= now.yaw_rate_radps <= high_radps + TINY, (self.motion, setpoint, now)


def nearer(before: float, now: float) -> bool:
    """True if a number is 0 or on the way to it."""
    return abs(now) <= abs(before) and before * now >= 0


def walk(seed: int, mode: str, ticks: int) -> None:
    seen = Walk(seed, mode).run(ticks)
    reasons = set(safety_rules.RULES) - {safety_rules.ENDS, safety_rules.NO_POSE}
    if mode == AUTOMATIC:
        reasons -= {safety_rules.NOT_ARMED}
    reasons |= {BLOCKED, MOVING, NEAR, SCAN_STALE, UNKNOWN}
    assert reasons <= set(seen), f"not met: {reasons - set(seen)}"
    assert seen["driven"] > 0.1 * ticks and seen["driven by planner"] > 0, seen


@pytest.mark.hazard("H01")
@pytest.mark.parametrize("mode", [MANUAL, AUTOMATIC])
def test_nothing_moves_without_arm_and_a_live_command_of_the_owner(mode: str) -> None:
    walk(1, mode, TICKS)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("mode", [MANUAL, AUTOMATIC])
def test_nothing_moves_without_arm_and_a_live_command_in_a_million_ticks(mode: str, seed: int) -> None:
    walk(100 + seed, mode, MANY_TICKS // 20)
