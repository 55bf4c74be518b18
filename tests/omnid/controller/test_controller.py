"""The base controller: each reason stops the wheels, a later setpoint starts them again, no limit is exceeded."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import pytest

from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.protocols.differential_drive import DifferentialDrive
from drivers.motors.serial_motor import LateReplyError, SerialMotor
from omnid.controller.controller import Controller
from omnid.controller.statistics import ControllerState
from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC
from omnid.core.control.collision_monitor import BLOCKED, CollisionSettings, ControllerScan
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import Setpoint
from omnid.core.control.safety_rules import Deadlines
from tests.contract.pty_motor import PtyMotor
from tests.omnid.controller.bench import (
    LIMITS,
    PERIOD_NS,
    PERIOD_S,
    SETTINGS,
    UNATTENDED,
    Bench,
)

PATIENCE_S = 20.0


@pytest.fixture
def bench() -> Bench:
    return Bench(UNATTENDED)


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


@pytest.mark.hazard("H13")
def test_stops_where_the_pose_is_stale(driving: Bench) -> None:
    def late() -> None:
        driving.send_pose(age_s=1.0)
        driving.send_setpoint()

    slows_down(driving, late)
    assert driving.controller.state.reason == safety_rules.POSE_STALE
    assert driving.controller.state.stops == {safety_rules.POSE_STALE: 1}
    assert driving.lines == ["the wheels stop: the pose is stale"]


@pytest.mark.hazard("H13")
def test_drives_slowly_where_the_pose_is_degraded(driving: Bench) -> None:
    """At half of the limits, which it comes to within the deceleration, and back again."""
    speeds = [driving.last.velocity_mps]
    for state in ["degraded"] * 10 + ["tracking"] * 10:
        driving.send_pose(state=state)
        driving.send_setpoint()
        driving.tick()
        speeds.append(driving.last.velocity_mps)
    assert speeds[10] == LIMITS.velocity_mps / 2 and speeds[-1] == pytest.approx(0.3)
    assert all(a - b <= LIMITS.deceleration_mps2 * PERIOD_S + 1e-6 for a, b in pairwise(speeds))
    assert (driving.controller.state.slowed, driving.controller.state.slowed_by) == (1, "")
    assert driving.lines == [] and not driving.controller.state.stops


@pytest.mark.hazard("H05")
def test_stops_where_no_more_setpoints_come(driving: Bench) -> None:
    for _ in range(9):
        driving.send_pose()
        driving.tick()
    assert driving.last.velocity_mps == 0.3, "0.45 s after the last one"
    slows_down(driving, driving.send_pose)
    assert driving.controller.state.stops == {safety_rules.COMMAND_STALE: 1}
    assert driving.controller.state.reason == safety_rules.IDLE


@pytest.mark.parametrize("turn_radps", [0.0, 0.4])
def test_a_drive_that_ends_by_a_setpoint_to_stand_is_not_called_cut_short(driving: Bench, turn_radps: float) -> None:
    """A goal is reached, the stick is in its middle: then its sender is silent. One to turn on the spot is to last."""
    driving.send_setpoint(Setpoint(0.0, None, turn_radps))
    for _ in range(20):
        driving.send_pose()
        driving.tick()
    assert is_stop(driving.last) and driving.controller.state.reason == safety_rules.IDLE
    assert bool(driving.lines) == bool(driving.controller.state.stops) == bool(turn_radps)


@pytest.mark.hazard("H40")
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


def test_measures_lateness_against_the_rhythm_of_the_earliest_ticks(bench: Bench) -> None:
    """Ticks that are all equally late are late; after a long gap the rhythm goes on as it was."""
    bench.tick()
    for late_ns in (5_000_000, 5_000_000, 120_000_000, 30_000_000):
        bench.now_ns = 10**12 + PERIOD_NS + bench.statistics.lateness.count * PERIOD_NS + late_ns
        if late_ns == 30_000_000:
            bench.now_ns += 2 * PERIOD_NS  # that were left out
        bench.statistics.add(bench.controller.tick())
    assert [round(bench.statistics.lateness.p(q), 3) for q in (0.2, 1.0)] == [0.0, 0.12]
    assert bench.statistics.lateness.p(0.6) == pytest.approx(0.005, rel=0.05)
    assert bench.statistics.lateness.p(0.8) == pytest.approx(0.03, rel=0.05)


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
    assert driving.lines == [
        "motor on /dev/x gave no answer",
        f"the wheels stop: {safety_rules.FAILED}",
        "the motor controller is back",
    ]


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


def test_sends_headings_in_the_motor_controllers_own_count(bench: Bench) -> None:
    """The goal leads the reported heading, on the side of the wanted one and not beyond it."""
    bench.wheels.heading_rad = -2.0  # while the base stands at 0.5 rad in odom
    bench.send_pose(0.5)
    bench.tick()
    for _ in range(40):
        bench.send_pose(0.5)
        bench.send_setpoint(Setpoint(0.2, 0.6))
        bench.tick()
        assert -2.0 < bench.last.heading_rad <= -2.0 + 0.1 + 1e-9
    assert bench.last.heading_rad == pytest.approx(-2.0 + 0.1)
    bench.wheels.heading_rad = -1.95  # its count drifts: odometry corrects it
    for _ in range(10):
        bench.send_pose(0.5)
        bench.send_setpoint(Setpoint(0.2, 0.6))
        bench.tick()
    assert bench.last.heading_rad == pytest.approx(-1.95 + 0.1)


@contextlib.contextmanager
def real_controller(twin: PtyMotor) -> Iterator[Controller]:
    driver = SerialMotor(twin.port, timeout_s=2.0, watchdog_ms=10_000)
    settings = ControllerSettings(Deadlines(5.0, 5.0, 5.0), LIMITS, arming=AUTOMATIC).without_obstacles
    controller = Controller(driver, settings, 0.02)
    try:
        yield controller
    finally:
        driver.close()


def run_until(controller: Controller, twin: PtyMotor, setpoint: Setpoint, happens: Callable[[], bool]) -> None:
    """Tick with the simulated base's heading as the pose; headings in odom are 0.7 rad larger."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not happens():
        assert time.monotonic() < deadline_s, "timeout"
        state = twin.base
        controller.take(ControllerPose(time.monotonic_ns(), state.pose[2] + 0.7, state.yaw_rate_radps, "tracking"))
        controller.take(TimedSetpoint(time.monotonic_ns(), setpoint))
        controller.tick()
        time.sleep(0.02)


@pytest.mark.parametrize("setpoint", [Setpoint(0.1, 1.1), Setpoint(0.1, None, 0.4), Setpoint(0.0, None, 0.4)])
def test_a_simulated_motor_that_holds_headings_follows_headings_and_rates(setpoint: Setpoint) -> None:
    """The line protocol's own heading controller gets headings in its count, 0.7 rad less than those in odom."""
    with contextlib.closing(PtyMotor()) as twin, real_controller(twin) as controller:
        if setpoint.heading_rad is not None:
            goal_rad = setpoint.heading_rad - 0.7
            run_until(controller, twin, setpoint, lambda: abs(twin.base.pose[2] - goal_rad) < 0.02)
        else:
            # On a busy machine a late tick lets the base reach the last heading, where it waits for the next one.
            run_until(
                controller,
                twin,
                setpoint,
                lambda: twin.base.pose[2] > 0.4 and twin.base.yaw_rate_radps == pytest.approx(0.4, abs=0.2),
            )
        controller.stop(time.monotonic_ns())
        heading_rad, slowed = twin.base.pose[2], time.monotonic() + PATIENCE_S
        while not (is_stop(twin.base.last_command) and twin.base.yaw_rate_radps == 0) and time.monotonic() < slowed:
            controller.tick()
            time.sleep(0.02)
        assert abs(twin.base.pose[2] - heading_rad) < 0.35, "it does not turn on to the void goal"


def test_slows_down_at_the_end_whatever_the_setpoint(driving: Bench) -> None:
    driving.controller.end()
    assert not driving.controller.is_at_rest
    slows_down(driving, lambda: send_both(driving))
    assert driving.controller.is_at_rest and driving.controller.state.reason == safety_rules.ENDS


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


@pytest.mark.parametrize("known", [True, False])
def test_wheels_that_are_limited_by_their_driver_follow_the_commands(known: bool) -> None:
    """A base whose wheels turn at 0.1 m/s at most is driven at 0.3 m/s; that is no fault if the limit is known."""
    slow = DifferentialDrive(max_wheel_mps=0.1)
    bench = Bench(UNATTENDED, slow if known else None)
    bench.wheels.drive, bench.wheels.velocity_mps = slow, None
    for _ in range(200):
        bench.send_pose(velocity_mps=0.1, sigma_mps=0.01)
        bench.send_setpoint()
        bench.tick()
    assert (not bench.controller.state.stops and not bench.controller.state.slowed) == known


def test_counts_commands_and_stops_before_obstacles() -> None:
    bench = Bench(replace(SETTINGS, collision=CollisionSettings()))

    def drive(ranges: tuple[float, ...], ticks: int) -> ControllerState:
        for _ in range(ticks):
            bench.send_pose()
            bench.controller.take(ControllerScan(bench.now_ns, ranges))
            bench.send_setpoint()
            bench.tick()
        return bench.controller.state

    bench.send_pose()
    bench.arm()
    bench.tick()
    free = (math.inf,) * 360
    state = drive(free, 20)
    assert state.sent == len(bench.wheels.commands) == 21 and not state.blocked and not state.obstacle
    slowed = drive(tuple(0.9 if 150 <= k < 210 else math.inf for k in range(360)), 3)
    assert slowed.obstacle and not slowed.blocked and slowed.obstacle_stops == 0
    for number in (1, 2):
        stopped = drive(tuple(0.38 if 150 <= k < 210 else math.inf for k in range(360)), 10)
        assert stopped.blocked and stopped.obstacle == BLOCKED and stopped.obstacle_stops == number
        assert not drive(free, 10).blocked
