"""The base controller: each reason stops the wheels, a later setpoint starts them again, no limit is exceeded."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.motor import MotorStatus, VelocityCommand, is_stop
from drivers.motors.protocols.motor_protocol import DifferentialDrive
from drivers.motors.serial_motor import LateReplyError
from drivers.motors.simulated_motor import MotionLimits, SimulatedBase
from omnid.controller.controller import Controller
from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC, MANUAL, TimedSetpoint
from omnid.core.control.control_law import ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import Setpoint, VelocityLimits
from omnid.core.control.safety_rules import POSE_JUMPED, Deadlines
from tests.omnid.controller.bench import LIMITS, PERIOD_S, UNATTENDED, Bench

HOLDER_LIMITS = VelocityLimits(yaw_rate_radps=1.0)
HOLDER_SETTINGS = ControllerSettings(Deadlines(5.0, 5.0, 5.0), HOLDER_LIMITS, arming=AUTOMATIC).without_obstacles
GAIN_HZ = 8.0
RIPPLE = 1.2  # the goal moves in steps, one a tick, and this motor controller follows within a tick
FAST = MotionLimits(yaw_rate_radps=10.0, yaw_acceleration_radps2=50.0, heading_gain_hz=GAIN_HZ)
STRAIGHT = Setpoint(0.2, None, 0.0)


class LockstepBase:
    """A simulated motor controller that holds headings, as a driver, in the time of the test."""

    def __init__(self) -> None:
        self.base = SimulatedBase(DifferentialDrive(), 500.0)
        self.base.limits = FAST
        self.fastest_radps = 0.0

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Take a command; the status is that before it."""
        base = self.base
        status = MotorStatus(base.velocity_mps, base.pose[2], base.yaw_rate_radps, False, 0, math.nan)
        base.goal_heading_rad = command.heading_rad
        base.command(command.velocity_mps, command.yaw_rate_radps)
        for _ in range(10):
            base.advance(PERIOD_S / 10)
            self.fastest_radps = max(self.fastest_radps, abs(base.yaw_rate_radps))
        return status

    def close(self) -> None:
        """Release nothing."""


class Lockstep:
    """A controller in front of it. jump_rad: of the heading in odom against that of the base."""

    def __init__(self) -> None:
        self.now_ns, self.jump_rad = 10**12, 0.0
        self.driver = LockstepBase()
        self.controller = Controller(self.driver, HOLDER_SETTINGS, PERIOD_S, clock_ns=lambda: self.now_ns)

    @property
    def heading_rad(self) -> float:
        return self.driver.base.pose[2]

    def run(self, setpoint: Setpoint, ticks: int) -> None:
        for _ in range(ticks):
            self.now_ns += round(PERIOD_S * 1e9)
            base = self.driver.base
            heading_rad = math.remainder(base.pose[2] + self.jump_rad, math.tau)
            self.controller.take(ControllerPose(self.now_ns, heading_rad, base.yaw_rate_radps, "tracking"))
            self.controller.take(TimedSetpoint(self.now_ns, setpoint))
            self.controller.tick()


@pytest.mark.hazard("H11")
@pytest.mark.parametrize("heading_rad", [3.0, -3.0, 0.2])
def test_the_yaw_rate_holds_on_the_way_to_a_far_heading(heading_rad: float) -> None:
    robot = Lockstep()
    robot.run(Setpoint(0.2, heading_rad), 200)
    assert robot.heading_rad == pytest.approx(heading_rad, abs=0.01)
    assert robot.driver.fastest_radps <= RIPPLE * HOLDER_LIMITS.yaw_rate_radps


@pytest.mark.hazard("H12")
@pytest.mark.parametrize("jump_rad", [1.5, -1.5, 3.1])
def test_a_pose_that_jumps_does_not_turn_a_base_that_drives_straight_on(jump_rad: float) -> None:
    robot = Lockstep()
    robot.run(STRAIGHT, 40)
    robot.jump_rad = jump_rad
    robot.run(STRAIGHT, 60)
    assert robot.heading_rad == pytest.approx(0.0, abs=1e-9)
    assert robot.controller.state.stops == {POSE_JUMPED: 1}, "its setpoints until then are void"


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
def test_the_base_drives_slowly_where_the_pose_is_degraded(driving: Bench) -> None:
    """At half of the limits, which it comes to within the deceleration, and back again."""
    speeds = [driving.last.velocity_mps]
    for state in ["degraded"] * 10 + ["tracking"] * 10:
        driving.send_pose(state=state)
        driving.send_setpoint()
        driving.tick()
        speeds.append(driving.last.velocity_mps)
    assert speeds[10] == LIMITS.velocity_mps / 2 and speeds[-1] == pytest.approx(0.3)
    assert all(a - b <= LIMITS.deceleration_mps2 * PERIOD_S + 1e-6 for a, b in pairwise(speeds))
    assert driving.controller.state.slowed_by == ""
    assert driving.lines == [] and not driving.controller.state.stops


@pytest.mark.hazard("H05")
def test_the_base_stops_where_no_more_setpoints_come(driving: Bench) -> None:
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
def test_an_overloaded_host_stops_the_base_and_voids_earlier_setpoints(driving: Bench) -> None:
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


def test_the_base_drives_on_where_an_answer_is_late(driving: Bench) -> None:
    send = driving.wheels.send

    def late(_: VelocityCommand) -> MotorStatus:
        raise LateReplyError("motor on /dev/x gave no answer")

    for wheels in (late, send):
        driving.wheels.send = wheels  # type: ignore[method-assign]
        send_both(driving)
        driving.tick()
    assert driving.controller.state.late == 1 and driving.controller.state.errors == 0
    assert driving.last.velocity_mps == 0.3 and driving.controller.state.reason == "" and driving.lines == []


def test_the_base_slows_down_at_the_end_whatever_the_setpoint(driving: Bench) -> None:
    driving.controller.end()
    assert not driving.controller.is_at_rest
    slows_down(driving, lambda: send_both(driving))
    assert driving.controller.is_at_rest and driving.controller.state.reason == safety_rules.ENDS


@pytest.mark.parametrize("known", [True, False])
def test_wheels_that_are_limited_by_their_driver_follow_the_commands(known: bool) -> None:
    """A base whose wheels turn at 0.1 m/s at most is driven at 0.3 m/s; that is no fault if the limit is known."""
    slow = DifferentialDrive(max_wheel_mps=0.1)
    bench = Bench(UNATTENDED, slow if known else None)
    bench.wheels.drive, bench.wheels.velocity_mps = slow, None
    slowed = False
    for _ in range(200):
        bench.send_pose(velocity_mps=0.1, sigma_mps=0.01)
        bench.send_setpoint()
        bench.tick()
        slowed |= bool(bench.controller.state.slowed_by)
    assert (not bench.controller.state.stops and not slowed) == known


# docs/safety.md: each hazard has a test that is marked with it, and each reason to stop says whether it disarms.
ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs/safety.md").read_text("utf-8")
MARK = re.compile(r"@pytest\.mark\.hazard\(([^)]*)\)")


def test_each_hazard_has_a_test_that_is_marked_with_it() -> None:
    hazards = re.findall(r"^\| (H\d+) \|", TEXT, re.MULTILINE)
    marks = {
        hazard
        for path in (ROOT / "tests").rglob("test_*.py")
        for names in MARK.findall(path.read_text("utf-8"))
        for hazard in re.findall(r"H\d+", names)
    }
    assert len(hazards) == len(set(hazards))
    assert set(hazards) == marks


def test_every_reason_to_stop_has_a_row_that_says_whether_it_disarms() -> None:
    """A row may have several reasons of one kind: it has the beginnings of the words of each."""
    rows = {
        cells[1].strip(): cells[3].strip()
        for line in TEXT.splitlines()
        if line.startswith("| ") and len(cells := line.split("|")) == 7
    }
    for reason in safety_rules.RULES:
        words = [word[:5] for word in reason.split() if len(word) > 3]
        found = [row for row in rows if all(word in row for word in words)]
        assert found, f"add a row for {reason!r} to the table of docs/safety.md"
        if reason not in (safety_rules.ENDS, safety_rules.NOT_ARMED):
            latches = reason in (*safety_rules.FAULTS, safety_rules.ASKED)
            assert rows[min(found, key=len)].startswith("yes" if latches else "no"), reason
    assert f'controller.arming = "{MANUAL}"' in TEXT and f'"{AUTOMATIC}"' in TEXT
