"""The base controller: what stops the wheels, what lets them turn again, and that nothing ever breaks a limit."""

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
    """A motor driver that takes notes; `silent` and `expired` are what the controller does next."""

    def __init__(self) -> None:
        self.told: list[VelocityCommand] = []
        self.silent = self.expired = self.closed = False
        self.heading_rad = math.nan

    def send(self, command: VelocityCommand) -> MotorStatus:
        """The notes grow."""
        if self.silent:
            raise DriverError("motor on /dev/x gave no answer")
        self.told.append(command)
        return MotorStatus(0.0, self.heading_rad, 0.0, self.expired, 0, math.nan)

    def close(self) -> None:
        """Noted."""
        self.closed = True


class Bench:
    """A controller on a clock that is set by hand."""

    def __init__(self) -> None:
        self.now_ns = 10**12
        self.wheels = Wheels()
        self.said: list[str] = []
        self.controller = Controller(self.wheels, SETTINGS, PERIOD_S, self.said.append, clock_ns=lambda: self.now_ns)
        self.logbook = ControllerStatistics(StageStats("motor"))

    @property
    def last(self) -> VelocityCommand:
        return self.wheels.told[-1]

    def see(self, heading_rad: float = 0.0, *, state: str = "tracking", rate_radps: float = 0.0,
            age_s: float = 0.0) -> None:
        self.controller.set_pose(ControllerPose(self.now_ns - round(age_s * 1e9), heading_rad, rate_radps, state))

    def ask(self, setpoint: Setpoint = AHEAD) -> None:
        self.now_ns += 1
        self.controller.set_command(TimedSetpoint(self.now_ns, setpoint))

    def stop(self) -> None:
        self.controller.stop(self.now_ns)

    def tick(self, late_s: float = 0.0) -> None:
        self.now_ns += PERIOD_NS + round(late_s * 1e9)
        self.logbook.add(self.controller.tick())

    def drive(self, ticks: int = 20, setpoint: Setpoint = AHEAD) -> None:
        for _ in range(ticks):
            self.see()
            self.ask(setpoint)
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
    """The wheels come to a stand within the deceleration, not at once; go_on is what else happens before each tick."""
    before = len(bench.wheels.told)
    for _ in range(10):
        go_on()
        bench.tick()
    speeds = [0.3, *(command.velocity_mps for command in bench.wheels.told[before:])]
    assert speeds[-1] == 0.0 and speeds[1] > 0.0
    assert all(0.0 <= a - b <= LIMITS.deceleration_mps2 * PERIOD_S + 1e-6 for a, b in pairwise(speeds))


def both(bench: Bench) -> None:
    bench.see()
    bench.ask()


def test_nothing_moves_without_a_pose_or_without_a_command(bench: Bench) -> None:
    bench.tick()
    assert bench.controller.state.reason == safety_rules.POSE_STALE
    bench.ask()
    bench.tick()
    assert is_stop(bench.last) and bench.controller.state.reason == safety_rules.POSE_STALE
    bench.see()
    bench.tick()
    assert is_stop(bench.last), "the command came before there was a pose"
    assert bench.controller.state.reason == safety_rules.IDLE
    bench.ask()
    bench.tick()
    assert bench.last.velocity_mps > 0.0
    assert bench.controller.state.stops == {} and bench.said == [], "nothing that drove was stopped"


def test_a_stale_pose_stops(driving: Bench) -> None:
    def late() -> None:
        driving.see(age_s=1.0)
        driving.ask()

    slows_down(driving, late)
    assert driving.controller.state.reason == safety_rules.POSE_STALE
    assert driving.controller.state.stops == {safety_rules.POSE_STALE: 1}
    assert driving.said == ["the wheels stop: the pose is stale"]


def test_a_pose_that_is_lost_stops(driving: Bench) -> None:
    def lose() -> None:
        driving.see(state="lost")
        driving.ask()

    slows_down(driving, lose)
    assert driving.controller.state.reason == safety_rules.POSE_LOST
    both(driving)
    driving.tick()
    assert driving.last.velocity_mps > 0.0, "found again, and asked anew"


def test_degraded_drives_on(driving: Bench) -> None:
    driving.see(state="degraded")
    driving.ask()
    driving.tick()
    assert driving.last.velocity_mps == 0.3


def test_when_commands_cease_the_wheels_stop(driving: Bench) -> None:
    for _ in range(9):
        driving.see()
        driving.tick()
    assert driving.last.velocity_mps == 0.3, "0.45 s after the last one"
    slows_down(driving, driving.see)
    assert driving.controller.state.stops == {safety_rules.COMMAND_STALE: 1}
    assert driving.controller.state.reason == safety_rules.IDLE


def test_a_stop_latches_until_a_command_that_comes_later(driving: Bench) -> None:
    driving.ask()
    driving.now_ns += 1
    driving.stop()
    driving.now_ns += 1
    driving.ask()  # within the same tick: the stop counts
    driving.tick()
    assert driving.controller.state.reason == safety_rules.ASKED
    slows_down_from = driving.last.velocity_mps
    assert 0.0 < slows_down_from < 0.3
    for _ in range(10):
        driving.see()
        driving.tick()
    assert is_stop(driving.last) and driving.controller.state.reason == safety_rules.IDLE
    both(driving)
    driving.tick()
    assert driving.last.velocity_mps > 0.0


def test_a_stop_that_comes_in_the_middle_of_a_tick_is_not_lost(driving: Bench) -> None:
    """A command and a stop after it arrive while the tick talks to the controller."""
    send = driving.wheels.send

    def busy(command: VelocityCommand) -> MotorStatus:
        driving.ask()
        driving.now_ns += 1000
        driving.stop()
        return send(command)

    driving.wheels.send = busy  # type: ignore[method-assign]
    both(driving)
    driving.tick()
    driving.wheels.send = send  # type: ignore[method-assign]
    driving.see()
    driving.tick()
    assert driving.controller.state.reason == safety_rules.ASKED
    slower = driving.last.velocity_mps
    driving.see()
    driving.tick()
    assert driving.last.velocity_mps < slower < 0.3, "the command before the stop is void"


def test_a_command_that_arrived_before_the_stop_but_is_handed_over_after_it_is_void(driving: Bench) -> None:
    arrival_ns = driving.now_ns
    driving.now_ns += 1
    driving.stop()
    for _ in range(10):
        driving.see()
        driving.tick()
    driving.controller.set_command(TimedSetpoint(arrival_ns, AHEAD))
    driving.tick()
    assert is_stop(driving.last)


def test_an_overloaded_host_stops_and_commands_from_before_are_void(driving: Bench) -> None:
    both(driving)
    driving.tick(late_s=0.26)
    assert driving.controller.state.reason == safety_rules.OVERLOADED and driving.last.velocity_mps < 0.3
    slows_down_to: list[float] = []
    for _ in range(10):
        driving.see()
        driving.tick()
        slows_down_to.append(driving.last.velocity_mps)
    assert slows_down_to[-1] == 0.0
    assert driving.logbook.lateness.max_s == pytest.approx(0.26)


def test_a_tick_that_is_a_little_late_does_not_stop(driving: Bench) -> None:
    both(driving)
    driving.tick(late_s=0.2)
    assert driving.controller.state.reason == "" and driving.last.velocity_mps == 0.3


def test_lateness_is_measured_against_the_rhythm(bench: Bench) -> None:
    """Ticks that are all late alike are late; after a long gap the rhythm goes on as it was."""
    bench.tick()
    for late_ns in (5_000_000, 5_000_000, 120_000_000, 30_000_000):
        bench.now_ns = 10**12 + PERIOD_NS + bench.logbook.lateness.count * PERIOD_NS + late_ns
        if late_ns == 30_000_000:
            bench.now_ns += 2 * PERIOD_NS  # that were left out
        bench.logbook.add(bench.controller.tick())
    assert [round(bench.logbook.lateness.p(q), 3) for q in (0.2, 1.0)] == [0.0, 0.12]
    assert bench.logbook.lateness.p(0.6) == pytest.approx(0.005, rel=0.02)
    assert bench.logbook.lateness.p(0.8) == pytest.approx(0.03, rel=0.02)


def test_a_motor_that_fails_voids_what_was_asked(driving: Bench) -> None:
    driving.wheels.silent = True
    for _ in range(3):
        both(driving)
        driving.tick()
    assert driving.controller.state.errors == 3 and driving.controller.state.failed
    driving.wheels.silent = False
    driving.tick()
    assert is_stop(driving.last) and driving.controller.state.reason == safety_rules.FAILED
    driving.see()
    driving.tick()
    assert is_stop(driving.last), "what was asked before the stop is void"
    both(driving)
    driving.tick()
    assert 0.0 < driving.last.velocity_mps <= LIMITS.acceleration_mps2 * PERIOD_S + 1e-9, "from a stand"
    assert driving.said == ["motor on /dev/x gave no answer", f"the wheels stop: {safety_rules.FAILED}",
                            "the motor controller is back"]


def test_an_answer_that_is_late_stops_nothing(driving: Bench) -> None:
    send = driving.wheels.send

    def late(_: VelocityCommand) -> MotorStatus:
        raise LateReplyError("motor on /dev/x gave no answer")

    for wheels in (late, send):
        driving.wheels.send = wheels  # type: ignore[method-assign]
        both(driving)
        driving.tick()
    assert driving.controller.state.late == 1 and driving.controller.state.errors == 0
    assert driving.last.velocity_mps == 0.3 and driving.controller.state.reason == "" and driving.said == []


def test_a_late_answer_does_not_hide_that_the_wheels_still_turn(driving: Bench) -> None:
    """The stop that was told without an answer is a step of the ramp, and the next goes on from there."""
    def late(_: VelocityCommand) -> MotorStatus:
        raise LateReplyError("motor on /dev/x gave no answer")

    send, driving.wheels.send = driving.wheels.send, late  # type: ignore[method-assign]
    driving.controller.end()
    driving.tick()
    assert not driving.controller.stands
    driving.wheels.send = send  # type: ignore[method-assign]
    driving.tick()
    assert driving.last.velocity_mps == pytest.approx(0.3 - 2 * LIMITS.deceleration_mps2 * PERIOD_S)


def test_a_controller_that_stopped_by_itself_starts_from_a_stand(driving: Bench) -> None:
    driving.wheels.expired = True
    both(driving)
    driving.tick()
    driving.wheels.expired = False
    both(driving)
    driving.tick()
    assert is_stop(driving.last) and driving.controller.state.stops == {safety_rules.STOPPED: 1}
    assert driving.controller.state.expiries == 1
    both(driving)
    driving.tick()
    assert 0.0 < driving.last.velocity_mps <= LIMITS.acceleration_mps2 * PERIOD_S + 1e-9


def test_the_heading_is_held_in_odom(bench: Bench) -> None:
    bench.see(0.5)
    bench.ask(Setpoint(0.2, 1.0))
    bench.tick()
    assert bench.last.yaw_rate_radps > 0.0
    bench.see(1.5)
    for _ in range(5):
        bench.ask(Setpoint(0.2, 1.0))
        bench.tick()
    assert bench.last.yaw_rate_radps < 0.0


def test_a_base_that_turns_is_where_it_turns_to(bench: Bench) -> None:
    """The pose is 0.4 s old, meanwhile the base has turned from 0 to 0.4 rad: past the goal."""
    bench.see(0.0, rate_radps=1.0, age_s=0.4 - PERIOD_S)
    bench.ask(Setpoint(0.2, 0.2))
    bench.tick()
    assert bench.last.yaw_rate_radps < 0.0


def test_a_controller_that_steers_is_told_headings_in_its_own_count(bench: Bench) -> None:
    bench.wheels.heading_rad = -2.0  # while the base stands at 0.5 rad in odom
    bench.see(0.5)
    bench.tick()
    bench.see(0.5)
    bench.ask(Setpoint(0.2, 0.8))
    bench.tick()
    assert bench.last.heading_rad == pytest.approx(-2.0 + 0.3)
    bench.wheels.heading_rad = -1.95  # its count drifts: odometry has the last word
    for _ in range(2):
        bench.see(0.5)
        bench.ask(Setpoint(0.2, 0.8))
        bench.tick()
    assert bench.last.heading_rad == pytest.approx(-1.95 + 0.3)


def test_while_it_slows_down_a_controller_that_steers_keeps_its_heading(bench: Bench) -> None:
    """It must not be sent to heading 0 of odom, nor on to a goal that is void."""
    bench.wheels.heading_rad = 1.0
    for _ in range(20):
        bench.see(1.0)
        bench.ask(Setpoint(0.3, 2.0))
        bench.tick()
    bench.stop()
    bench.now_ns += 1
    bench.see(1.0)
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
    """Ticks with the twin's own heading as the pose, in odom 0.7 rad further."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not happens():
        assert time.monotonic() < deadline_s, "it did not happen"
        state = twin.base
        controller.set_pose(ControllerPose(time.monotonic_ns(), state.pose[2] + 0.7, state.yaw_rate_radps, "tracking"))
        controller.set_command(TimedSetpoint(time.monotonic_ns(), setpoint))
        controller.tick()
        time.sleep(0.02)


@pytest.mark.parametrize("setpoint", [Setpoint(0.1, 1.1), Setpoint(0.1, None, 0.4), Setpoint(0.0, None, 0.4)])
def test_a_twin_that_steers_by_itself_obeys_headings_and_rates(setpoint: Setpoint) -> None:
    """The line protocol's own heading hold gets headings in its count; odom's differ by 0.7 rad."""
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
        assert abs(twin.pose[2] - heading_rad) < 0.35, "it does not go on to where nobody wants it any more"


def test_at_the_end_the_wheels_slow_down_whatever_is_asked(driving: Bench) -> None:
    driving.controller.end()
    assert not driving.controller.stands
    slows_down(driving, lambda: both(driving))
    assert driving.controller.stands and driving.controller.state.reason == safety_rules.ENDS


def test_a_controller_that_fails_needs_no_ramp(driving: Bench) -> None:
    driving.wheels.silent = True
    driving.tick()
    assert driving.controller.stands


def test_what_a_tick_came_to(driving: Bench) -> None:
    """A pose counts once on its way to the wheels; what is not sent is not told."""
    driving.see(age_s=0.01)
    driving.now_ns += PERIOD_NS
    tick = driving.controller.tick()
    assert tick.command == driving.last and tick.to_wheel_s == pytest.approx(0.06)
    driving.now_ns += PERIOD_NS
    assert math.isnan(driving.controller.tick().to_wheel_s)
    driving.wheels.silent = True
    driving.see()
    driving.now_ns += 4 * PERIOD_NS
    tick = driving.controller.tick()
    assert tick.command is None and math.isnan(tick.to_wheel_s)
    assert tick.late_s == pytest.approx(3 * PERIOD_S) and tick.state.missed == 3


@pytest.mark.parametrize("seed", range(6))
def test_whatever_comes_no_limit_breaks_and_nothing_moves_unasked(seed: int) -> None:
    """1,000 ticks each of random poses, commands, stops, pauses and failures."""
    rng, bench = random.Random(seed), Bench()
    asked = False  # a command has come since the last stop
    spoken = last = VelocityCommand(bench.now_ns, 0.0, 0.0, 0.0)
    for _ in range(1000):
        bench.now_ns += rng.randrange(1, 1000)
        if rng.random() < 0.9:
            bench.see(rng.uniform(-4, 4), state=rng.choice(["tracking"] * 20 + ["degraded", "lost"]),
                      rate_radps=rng.uniform(-2, 2), age_s=rng.choice([0.0, 0.1, 0.1, rng.uniform(-1, 1)]))
        if rng.random() < 0.5:
            bench.ask(Setpoint(rng.choice([math.nan, math.inf, *(rng.uniform(-3, 3) for _ in range(20))]),
                               rng.choice([None, None, rng.uniform(-9, 9), math.nan]), rng.uniform(-5, 5)))
            asked = True
        if rng.random() < 0.03:
            bench.now_ns += 1
            bench.stop()
            asked = False
        bench.wheels.silent, bench.wheels.expired = rng.random() < 0.02, rng.random() < 0.02
        count = len(bench.wheels.told)
        bench.tick(late_s=rng.choice([0.0] * 30 + [0.1, 0.5]))
        asked = asked and not bench.controller.state.reason
        if len(bench.wheels.told) == count or bench.wheels.expired:
            spoken = VelocityCommand(bench.now_ns, 0.0, 0.0, 0.0)  # the controller stands, or will
            asked = asked and len(bench.wheels.told) > count
        last, before = bench.last if len(bench.wheels.told) > count else spoken, spoken
        if len(bench.wheels.told) > count:
            breaks_no_limit(before if not bench.wheels.expired else None, last)
            assert asked or slows(before, last) or bench.wheels.expired, (before, last)
            spoken = spoken if bench.wheels.expired else last
    assert any(not is_stop(command) for command in bench.wheels.told), "it drove at all"


def breaks_no_limit(before: VelocityCommand | None, now: VelocityCommand) -> None:
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
    """Whether a motion is a stop or on the way to one."""
    def nearer(a: float, b: float) -> bool:
        return abs(b) <= abs(a) and a * b >= 0

    return nearer(before.velocity_mps, now.velocity_mps) and nearer(before.yaw_rate_radps, now.yaw_rate_radps)
