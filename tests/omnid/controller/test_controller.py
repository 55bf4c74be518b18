"""The base controller: each reason stops the wheels, a later setpoint starts them again, no limit is exceeded."""

from __future__ import annotations

import contextlib
import math
import random
import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest

from drivers.errors import DriverError
from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.serial_motor import LateReplyError, SerialMotor
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from omnid.controller.controller import Controller
from omnid.controller.statistics import ControllerStatistics
from omnid.core.control import safety_rules
from omnid.core.control.control_law import ControllerPose, ControllerSettings, TimedSetpoint
from omnid.core.control.heading_controller import LONGEST_TICK_S, HeadingLimits, Setpoint
from omnid.core.control.safety_rules import Deadlines
from omnid.core.control.velocity_limits import VelocityLimits
from omnid.engine.telemetry import StageStats

PERIOD_S = 0.05
PERIOD_NS = 50_000_000
PATIENCE_S = 20.0
LIMITS = VelocityLimits(velocity_mps=0.4, acceleration_mps2=0.6, deceleration_mps2=1.5, yaw_rate_radps=0.8,
                       yaw_acceleration_radps2=4.0)
SETTINGS = ControllerSettings(Deadlines(), LIMITS, HeadingLimits(velocity_mps=1.0, acceleration_mps2=5.0))
AHEAD = Setpoint(0.3, None, 0.0)


class Wheels:
    """A motor driver that keeps its commands; `silent` and `expired`: behaviour at the next command."""

    def __init__(self) -> None:
        self.commands: list[VelocityCommand] = []
        self.silent = self.expired = self.closed = False
        self.heading_rad = math.nan

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Keep the command."""
        if self.silent:
            raise DriverError("motor on /dev/x gave no answer")
        self.commands.append(command)
        return MotorStatus(0.0, self.heading_rad, 0.0, self.expired, 0, math.nan)

    def close(self) -> None:
        """Note that it was closed."""
        self.closed = True


class Bench:
    """A controller on a clock that is set by hand."""

    def __init__(self) -> None:
        self.now_ns = 10**12
        self.wheels = Wheels()
        self.lines: list[str] = []
        self.controller = Controller(self.wheels, SETTINGS, PERIOD_S, self.lines.append, clock_ns=lambda: self.now_ns)
        self.statistics = ControllerStatistics(StageStats("motor"))

    @property
    def last(self) -> VelocityCommand:
        return self.wheels.commands[-1]

    def send_pose(self, heading_rad: float = 0.0, *, state: str = "tracking", rate_radps: float = 0.0,
            age_s: float = 0.0) -> None:
        self.controller.set_pose(ControllerPose(self.now_ns - round(age_s * 1e9), heading_rad, rate_radps, state))

    def send_setpoint(self, setpoint: Setpoint = AHEAD) -> None:
        self.now_ns += 1
        self.controller.set_command(TimedSetpoint(self.now_ns, setpoint))

    def stop(self) -> None:
        self.controller.stop(self.now_ns)

    def tick(self, late_s: float = 0.0) -> None:
        self.now_ns += PERIOD_NS + round(late_s * 1e9)
        self.statistics.add(self.controller.tick())

    def drive(self, ticks: int = 20, setpoint: Setpoint = AHEAD) -> None:
        for _ in range(ticks):
            self.send_pose()
            self.send_setpoint(setpoint)
            self.tick()


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def driving(bench: Bench) -> Bench:
    bench.drive()
    assert bench.last.velocity_mps == 0.3 and bench.controller.state.reason == ""
    return bench


def slows_down(bench: Bench, go_on: Callable[[], None]) -> None:
    """Expect the wheels to stop within the deceleration, not at once; go_on is called before each tick."""
    before = len(bench.wheels.commands)
    for _ in range(10):
        go_on()
        bench.tick()
    speeds = [0.3, *(command.velocity_mps for command in bench.wheels.commands[before:])]
    assert speeds[-1] == 0.0 and speeds[1] > 0.0
    assert all(0.0 <= a - b <= LIMITS.deceleration_mps2 * PERIOD_S + 1e-6 for a, b in pairwise(speeds))


def send_both(bench: Bench) -> None:
    bench.send_pose()
    bench.send_setpoint()


def test_does_not_move_without_a_pose_or_without_a_setpoint(bench: Bench) -> None:
    bench.tick()
    assert bench.controller.state.reason == safety_rules.POSE_STALE
    bench.send_setpoint()
    bench.tick()
    assert is_stop(bench.last) and bench.controller.state.reason == safety_rules.POSE_STALE
    bench.send_pose()
    bench.tick()
    assert is_stop(bench.last), "the setpoint arrived before the pose"
    assert bench.controller.state.reason == safety_rules.IDLE
    bench.send_setpoint()
    bench.tick()
    assert bench.last.velocity_mps > 0.0
    assert bench.controller.state.stops == {} and bench.lines == [], "no motion was stopped"


def test_stops_where_the_pose_is_stale(driving: Bench) -> None:
    def late() -> None:
        driving.send_pose(age_s=1.0)
        driving.send_setpoint()

    slows_down(driving, late)
    assert driving.controller.state.reason == safety_rules.POSE_STALE
    assert driving.controller.state.stops == {safety_rules.POSE_STALE: 1}
    assert driving.lines == ["the wheels stop: the pose is stale"]


def test_stops_where_the_pose_is_lost(driving: Bench) -> None:
    def lose() -> None:
        driving.send_pose(state="lost")
        driving.send_setpoint()

    slows_down(driving, lose)
    assert driving.controller.state.reason == safety_rules.POSE_LOST
    send_both(driving)
    driving.tick()
    assert driving.last.velocity_mps > 0.0, "found again, and a new setpoint"


def test_drives_on_where_the_pose_is_degraded(driving: Bench) -> None:
    driving.send_pose(state="degraded")
    driving.send_setpoint()
    driving.tick()
    assert driving.last.velocity_mps == 0.3


def test_stops_where_no_more_setpoints_come(driving: Bench) -> None:
    for _ in range(9):
        driving.send_pose()
        driving.tick()
    assert driving.last.velocity_mps == 0.3, "0.45 s after the last one"
    slows_down(driving, driving.send_pose)
    assert driving.controller.state.stops == {safety_rules.COMMAND_STALE: 1}
    assert driving.controller.state.reason == safety_rules.IDLE


def test_a_stop_latches_until_a_later_setpoint(driving: Bench) -> None:
    driving.send_setpoint()
    driving.now_ns += 1
    driving.stop()
    driving.now_ns += 1
    driving.send_setpoint()  # within the same tick: the stop counts
    driving.tick()
    assert driving.controller.state.reason == safety_rules.ASKED
    slows_down_from = driving.last.velocity_mps
    assert 0.0 < slows_down_from < 0.3
    for _ in range(10):
        driving.send_pose()
        driving.tick()
    assert is_stop(driving.last) and driving.controller.state.reason == safety_rules.IDLE
    send_both(driving)
    driving.tick()
    assert driving.last.velocity_mps > 0.0


def test_a_stop_during_a_tick_is_not_lost(driving: Bench) -> None:
    """A setpoint and after it a stop arrive while the tick waits for the motor controller."""
    send = driving.wheels.send

    def busy(command: VelocityCommand) -> MotorStatus:
        driving.send_setpoint()
        driving.now_ns += 1000
        driving.stop()
        return send(command)

    driving.wheels.send = busy  # type: ignore[method-assign]
    send_both(driving)
    driving.tick()
    driving.wheels.send = send  # type: ignore[method-assign]
    driving.send_pose()
    driving.tick()
    assert driving.controller.state.reason == safety_rules.ASKED
    slower = driving.last.velocity_mps
    driving.send_pose()
    driving.tick()
    assert driving.last.velocity_mps < slower < 0.3, "the setpoint before the stop is void"


def test_a_setpoint_that_arrived_before_the_stop_but_is_passed_on_after_it_is_void(driving: Bench) -> None:
    arrival_ns = driving.now_ns
    driving.now_ns += 1
    driving.stop()
    for _ in range(10):
        driving.send_pose()
        driving.tick()
    driving.controller.set_command(TimedSetpoint(arrival_ns, AHEAD))
    driving.tick()
    assert is_stop(driving.last)


def test_stops_on_an_overloaded_host_and_voids_earlier_setpoints(driving: Bench) -> None:
    send_both(driving)
    driving.tick(late_s=0.26)
    assert driving.controller.state.reason == safety_rules.OVERLOADED and driving.last.velocity_mps < 0.3
    slows_down_to: list[float] = []
    for _ in range(10):
        driving.send_pose()
        driving.tick()
        slows_down_to.append(driving.last.velocity_mps)
    assert slows_down_to[-1] == 0.0
    assert driving.statistics.lateness.max_s == pytest.approx(0.26)


def test_drives_on_where_a_tick_is_a_little_late(driving: Bench) -> None:
    send_both(driving)
    driving.tick(late_s=0.2)
    assert driving.controller.state.reason == "" and driving.last.velocity_mps == 0.3


def test_measures_lateness_against_the_rhythm_of_the_earliest_ticks(bench: Bench) -> None:
    """Ticks that are all equally late are late; after a long gap the rhythm goes on as it was."""
    bench.tick()
    for late_ns in (5_000_000, 5_000_000, 120_000_000, 30_000_000):
        bench.now_ns = 10**12 + PERIOD_NS + bench.statistics.lateness.count * PERIOD_NS + late_ns
        if late_ns == 30_000_000:
            bench.now_ns += 2 * PERIOD_NS  # that were left out
        bench.statistics.add(bench.controller.tick())
    assert [round(bench.statistics.lateness.p(q), 3) for q in (0.2, 1.0)] == [0.0, 0.12]
    assert bench.statistics.lateness.p(0.6) == pytest.approx(0.005, rel=0.02)
    assert bench.statistics.lateness.p(0.8) == pytest.approx(0.03, rel=0.02)


def test_a_motor_that_fails_voids_earlier_setpoints(driving: Bench) -> None:
    driving.wheels.silent = True
    for _ in range(3):
        send_both(driving)
        driving.tick()
    assert driving.controller.state.errors == 3 and driving.controller.state.failed
    driving.wheels.silent = False
    driving.tick()
    assert is_stop(driving.last) and driving.controller.state.reason == safety_rules.FAILED
    driving.send_pose()
    driving.tick()
    assert is_stop(driving.last), "the setpoint before the stop is void"
    send_both(driving)
    driving.tick()
    assert 0.0 < driving.last.velocity_mps <= LIMITS.acceleration_mps2 * PERIOD_S + 1e-9, "from a stop"
    assert driving.lines == ["motor on /dev/x gave no answer", f"the wheels stop: {safety_rules.FAILED}",
                            "the motor controller is back"]


def test_drives_on_where_an_answer_is_late(driving: Bench) -> None:
    send = driving.wheels.send

    def late(_: VelocityCommand) -> MotorStatus:
        raise LateReplyError("motor on /dev/x gave no answer")

    for wheels in (late, send):
        driving.wheels.send = wheels  # type: ignore[method-assign]
        send_both(driving)
        driving.tick()
    assert driving.controller.state.late == 1 and driving.controller.state.errors == 0
    assert driving.last.velocity_mps == 0.3 and driving.controller.state.reason == "" and driving.lines == []


def test_continues_the_ramp_after_a_late_answer(driving: Bench) -> None:
    """A command without an answer counts as a step of the ramp to the stop."""
    def late(_: VelocityCommand) -> MotorStatus:
        raise LateReplyError("motor on /dev/x gave no answer")

    send, driving.wheels.send = driving.wheels.send, late  # type: ignore[method-assign]
    driving.controller.end()
    driving.tick()
    assert not driving.controller.stands
    driving.wheels.send = send  # type: ignore[method-assign]
    driving.tick()
    assert driving.last.velocity_mps == pytest.approx(0.3 - 2 * LIMITS.deceleration_mps2 * PERIOD_S)


def test_starts_from_a_stop_where_the_motor_controller_had_stopped_by_itself(driving: Bench) -> None:
    driving.wheels.expired = True
    send_both(driving)
    driving.tick()
    driving.wheels.expired = False
    send_both(driving)
    driving.tick()
    assert is_stop(driving.last) and driving.controller.state.stops == {safety_rules.STOPPED: 1}
    assert driving.controller.state.expiries == 1
    send_both(driving)
    driving.tick()
    assert 0.0 < driving.last.velocity_mps <= LIMITS.acceleration_mps2 * PERIOD_S + 1e-9


def test_holds_the_heading_in_odom(bench: Bench) -> None:
    bench.send_pose(0.5)
    bench.send_setpoint(Setpoint(0.2, 1.0))
    bench.tick()
    assert bench.last.yaw_rate_radps > 0.0
    bench.send_pose(1.5)
    for _ in range(5):
        bench.send_setpoint(Setpoint(0.2, 1.0))
        bench.tick()
    assert bench.last.yaw_rate_radps < 0.0


def test_extrapolates_the_heading_of_a_base_that_turns(bench: Bench) -> None:
    """The pose is 0.4 s old, meanwhile the base has turned from 0 to 0.4 rad: past the goal."""
    bench.send_pose(0.0, rate_radps=1.0, age_s=0.4 - PERIOD_S)
    bench.send_setpoint(Setpoint(0.2, 0.2))
    bench.tick()
    assert bench.last.yaw_rate_radps < 0.0


def test_sends_headings_in_the_motor_controllers_own_count(bench: Bench) -> None:
    bench.wheels.heading_rad = -2.0  # while the base stands at 0.5 rad in odom
    bench.send_pose(0.5)
    bench.tick()
    bench.send_pose(0.5)
    bench.send_setpoint(Setpoint(0.2, 0.8))
    bench.tick()
    assert bench.last.heading_rad == pytest.approx(-2.0 + 0.3)
    bench.wheels.heading_rad = -1.95  # its count drifts: odometry corrects it
    for _ in range(2):
        bench.send_pose(0.5)
        bench.send_setpoint(Setpoint(0.2, 0.8))
        bench.tick()
    assert bench.last.heading_rad == pytest.approx(-1.95 + 0.3)


def test_keeps_the_motor_controllers_heading_while_it_slows_down(bench: Bench) -> None:
    """The goal must be neither heading 0 of odom nor that of a void setpoint."""
    bench.wheels.heading_rad = 1.0
    for _ in range(20):
        bench.send_pose(1.0)
        bench.send_setpoint(Setpoint(0.3, 2.0))
        bench.tick()
    bench.stop()
    bench.now_ns += 1
    bench.send_pose(1.0)
    bench.tick()
    assert bench.last.velocity_mps > 0.0 and bench.last.heading_rad == pytest.approx(1.0)


@contextlib.contextmanager
def real_controller(twin: SimulatedMotor) -> Iterator[Controller]:
    driver = SerialMotor(twin.port, timeout_s=2.0, watchdog_ms=10_000)
    controller = Controller(driver, ControllerSettings(Deadlines(5.0, 5.0, 5.0), LIMITS), 0.02)
    try:
        yield controller
    finally:
        driver.close()


def run_until(controller: Controller, twin: SimulatedMotor, setpoint: Setpoint, happens: Callable[[], bool]) -> None:
    """Tick with the simulated base's heading as the pose; headings in odom are 0.7 rad larger."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not happens():
        assert time.monotonic() < deadline_s, "timeout"
        state = twin.base
        controller.set_pose(ControllerPose(time.monotonic_ns(), state.pose[2] + 0.7, state.yaw_rate_radps, "tracking"))
        controller.set_command(TimedSetpoint(time.monotonic_ns(), setpoint))
        controller.tick()
        time.sleep(0.02)


@pytest.mark.parametrize("setpoint", [Setpoint(0.1, 1.1), Setpoint(0.1, None, 0.4), Setpoint(0.0, None, 0.4)])
def test_a_simulated_motor_that_holds_headings_follows_headings_and_rates(setpoint: Setpoint) -> None:
    """The line protocol's own heading controller gets headings in its count, 0.7 rad less than those in odom."""
    with contextlib.closing(SimulatedMotor()) as twin, real_controller(twin) as controller:
        if setpoint.heading_rad is not None:
            goal_rad = setpoint.heading_rad - 0.7
            run_until(controller, twin, setpoint, lambda: abs(twin.pose[2] - goal_rad) < 0.02)
        else:
            run_until(controller, twin, setpoint, lambda: twin.pose[2] > 0.4)
            assert twin.base.yaw_rate_radps == pytest.approx(0.4, abs=0.2)
        controller.stop(time.monotonic_ns())
        heading_rad, slowed = twin.pose[2], time.monotonic() + PATIENCE_S
        while not (is_stop(twin.last_command) and twin.base.yaw_rate_radps == 0) and time.monotonic() < slowed:
            controller.tick()
            time.sleep(0.02)
        assert abs(twin.pose[2] - heading_rad) < 0.35, "it does not turn on to the void goal"


def test_slows_down_at_the_end_whatever_the_setpoint(driving: Bench) -> None:
    driving.controller.end()
    assert not driving.controller.stands
    slows_down(driving, lambda: send_both(driving))
    assert driving.controller.stands and driving.controller.state.reason == safety_rules.ENDS


def test_needs_no_ramp_where_the_motor_controller_failed(driving: Bench) -> None:
    driving.wheels.silent = True
    driving.tick()
    assert driving.controller.stands


def test_reports_each_tick(driving: Bench) -> None:
    """The latency of a pose is reported once; a command that was not answered is not reported."""
    driving.send_pose(age_s=0.01)
    driving.now_ns += PERIOD_NS
    tick = driving.controller.tick()
    assert tick.command == driving.last and tick.to_wheel_s == pytest.approx(0.06)
    driving.now_ns += PERIOD_NS
    assert math.isnan(driving.controller.tick().to_wheel_s)
    driving.wheels.silent = True
    driving.send_pose()
    driving.now_ns += 4 * PERIOD_NS
    tick = driving.controller.tick()
    assert tick.command is None and math.isnan(tick.to_wheel_s)
    assert tick.late_s == pytest.approx(3 * PERIOD_S) and tick.state.missed == 3


@pytest.mark.parametrize("seed", range(6))
def test_never_exceeds_a_limit_or_moves_without_a_setpoint(seed: int) -> None:
    """1,000 ticks each of random poses, commands, stops, pauses and failures."""
    rng, bench = random.Random(seed), Bench()
    asked = False  # a setpoint has come since the last stop
    previous = last = VelocityCommand(bench.now_ns, 0.0, 0.0, 0.0)
    for _ in range(1000):
        bench.now_ns += rng.randrange(1, 1000)
        if rng.random() < 0.9:
            bench.send_pose(rng.uniform(-4, 4), state=rng.choice(["tracking"] * 20 + ["degraded", "lost"]),
                      rate_radps=rng.uniform(-2, 2), age_s=rng.choice([0.0, 0.1, 0.1, rng.uniform(-1, 1)]))
        if rng.random() < 0.5:
            bench.send_setpoint(Setpoint(rng.choice([math.nan, math.inf, *(rng.uniform(-3, 3) for _ in range(20))]),
                               rng.choice([None, None, rng.uniform(-9, 9), math.nan]), rng.uniform(-5, 5)))
            asked = True
        if rng.random() < 0.03:
            bench.now_ns += 1
            bench.stop()
            asked = False
        bench.wheels.silent, bench.wheels.expired = rng.random() < 0.02, rng.random() < 0.02
        count = len(bench.wheels.commands)
        bench.tick(late_s=rng.choice([0.0] * 30 + [0.1, 0.5]))
        asked = asked and not bench.controller.state.reason
        if len(bench.wheels.commands) == count or bench.wheels.expired:
            previous = VelocityCommand(bench.now_ns, 0.0, 0.0, 0.0)  # the motor controller stands, or will
            asked = asked and len(bench.wheels.commands) > count
        last, before = bench.last if len(bench.wheels.commands) > count else previous, previous
        if len(bench.wheels.commands) > count:
            exceeds_no_limit(before if not bench.wheels.expired else None, last)
            assert asked or slows(before, last) or bench.wheels.expired, (before, last)
            previous = previous if bench.wheels.expired else last
    assert any(not is_stop(command) for command in bench.wheels.commands), "it drove"


def exceeds_no_limit(before: VelocityCommand | None, now: VelocityCommand) -> None:
    assert all(map(math.isfinite, (now.velocity_mps, now.heading_rad, now.yaw_rate_radps)))
    assert abs(now.velocity_mps) <= LIMITS.velocity_mps and abs(now.yaw_rate_radps) <= LIMITS.yaw_rate_radps
    if before is None:
        return
    dt_s = min(LONGEST_TICK_S, (now.stamp_ns - before.stamp_ns) * 1e-9) + 1e-6
    turned_radps = now.yaw_rate_radps - before.yaw_rate_radps
    assert abs(turned_radps) <= LIMITS.yaw_acceleration_radps2 * dt_s + 1e-9
    gained_mps = abs(now.velocity_mps) - abs(before.velocity_mps)
    most_mps2 = LIMITS.acceleration_mps2 if gained_mps > 0 else LIMITS.deceleration_mps2
    assert abs(gained_mps) <= most_mps2 * dt_s + 1e-9


def slows(before: VelocityCommand, now: VelocityCommand) -> bool:
    """True if a motion is a stop or on the way to one."""
    def nearer(a: float, b: float) -> bool:
        return abs(b) <= abs(a) and a * b >= 0

    return nearer(before.velocity_mps, now.velocity_mps) and nearer(before.yaw_rate_radps, now.yaw_rate_radps)
