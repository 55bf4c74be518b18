"""Motor controllers that hold headings by themselves, faster than the limits allow: limits hold, jumps do not turn."""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import replace

import pytest

from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.serial_motor import SerialMotor
from drivers.motors.simulated.simulated_base import MotionLimits, SimulatedBase
from drivers.motors.simulated.simulated_line import SimulatedLine
from omnid.controller.controller import Controller
from omnid.core.control.arming import AUTOMATIC, ArmRequest
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.control_law import ControllerPose, ControllerSettings
from omnid.core.control.heading_controller import (
    HeadingLimits,
    Setpoint,
    VelocityLimits,
    longest_lead_rad,
)
from omnid.core.control.safety_rules import POSE_JUMPED, Deadlines
from tests.contract.pty_motor import PtyMotor

PERIOD_S = 0.05
LIMITS = VelocityLimits(yaw_rate_radps=1.0)
SETTINGS = ControllerSettings(
    Deadlines(5.0, 5.0, 5.0), LIMITS, HeadingLimits(yaw_rate_radps=1.0), arming=AUTOMATIC
).without_obstacles
GAIN_HZ = 8.0
RIPPLE = 1.2  # the goal moves in steps, one a tick, and this motor controller follows within a tick
FAST = MotionLimits(yaw_rate_radps=10.0, yaw_acceleration_radps2=50.0, heading_gain_hz=GAIN_HZ)
STRAIGHT = Setpoint(0.2, None, 0.0)


class LockstepBase:
    """A simulated motor controller that holds headings, as a driver, in the time of the test."""

    def __init__(self) -> None:
        self.base = SimulatedBase(limits=FAST)
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
        self.controller = Controller(self.driver, SETTINGS, PERIOD_S, clock_ns=lambda: self.now_ns)

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
    assert robot.driver.fastest_radps <= RIPPLE * LIMITS.yaw_rate_radps


@pytest.mark.hazard("H12")
@pytest.mark.parametrize("jump_rad", [1.5, -1.5, 3.1])
def test_a_pose_that_jumps_does_not_turn_a_base_that_drives_straight_on(jump_rad: float) -> None:
    robot = Lockstep()
    robot.run(STRAIGHT, 40)
    robot.jump_rad = jump_rad
    robot.run(STRAIGHT, 60)
    assert robot.heading_rad == pytest.approx(0.0, abs=1e-9)
    assert robot.controller.state.stops == {POSE_JUMPED: 1}, "its setpoints until then are void"


def test_after_a_jump_a_heading_is_the_one_of_the_corrected_odometry() -> None:
    """Within the limits: commands after the jump are those of an operator who sees it."""
    robot = Lockstep()
    robot.run(Setpoint(0.2, 0.0), 40)
    robot.jump_rad = 1.5
    robot.run(Setpoint(0.2, 0.0), 200)
    assert robot.heading_rad == pytest.approx(-1.5, abs=0.01)
    assert robot.driver.fastest_radps <= RIPPLE * LIMITS.yaw_rate_radps


@pytest.mark.hazard("H12")
def test_a_setpoint_from_before_a_jump_is_void_and_the_robot_stays_armed() -> None:
    robot = Lockstep()
    robot.controller = Controller(
        robot.driver, replace(SETTINGS, arming="manual"), PERIOD_S, clock_ns=lambda: robot.now_ns
    )
    robot.run(STRAIGHT, 2)
    robot.controller.take(ArmRequest(robot.now_ns))
    robot.run(STRAIGHT, 40)
    assert robot.driver.base.velocity_mps > 0.15
    for _ in range(20):  # the operator sends no more, and the pose jumps
        robot.now_ns += round(PERIOD_S * 1e9)
        robot.controller.take(ControllerPose(robot.now_ns, 1.5, 0.0, "tracking"))
        robot.controller.tick()
    assert robot.heading_rad == 0.0 and robot.driver.base.velocity_mps == 0.0
    robot.jump_rad = 1.5
    robot.run(STRAIGHT, 40)
    assert robot.driver.base.velocity_mps > 0.15, "it obeys the next one"


def test_a_stale_pose_that_was_relocalised_moves_no_goal() -> None:
    """Wheels stand for a stale pose, which then is another one: the goal stays the heading that they have."""
    robot = Lockstep()
    robot.run(STRAIGHT, 40)
    for _ in range(120):  # no poses for 6 s
        robot.now_ns += round(PERIOD_S * 1e9)
        robot.controller.tick()
    robot.jump_rad = 2.0
    stale = ControllerPose(robot.now_ns - 6 * 10**9, 2.0, 0.0, "tracking")
    robot.controller.take(stale)
    robot.controller.tick()
    robot.run(STRAIGHT, 60)
    assert robot.driver.base.velocity_mps > 0.15 and robot.heading_rad == pytest.approx(0.0, abs=1e-9)


def test_a_real_serial_line_shows_the_same() -> None:
    """In real time on a pty; on a busy machine the bound is the lead times the motor controller's gain."""
    twin = PtyMotor(SimulatedLine(limits=FAST))
    fastest_radps = 0.0
    with contextlib.closing(twin), contextlib.closing(SerialMotor(twin.port, timeout_s=1.0, watchdog_ms=9000)) as wire:
        controller, until_s = Controller(wire, SETTINGS, PERIOD_S), time.monotonic() + 2.5
        while time.monotonic() < until_s:
            base = twin.base
            controller.take(ControllerPose(time.monotonic_ns(), base.pose[2], base.yaw_rate_radps, "tracking"))
            controller.take(TimedSetpoint(time.monotonic_ns(), Setpoint(0.2, 3.0)))
            controller.tick()
            for _ in range(5):
                time.sleep(PERIOD_S / 5)
                fastest_radps = max(fastest_radps, abs(twin.base.yaw_rate_radps))
        assert twin.base.pose[2] > 0.5, "it turns"
    assert fastest_radps <= GAIN_HZ * longest_lead_rad(SETTINGS.heading, LIMITS) + 0.1 < FAST.yaw_rate_radps / 2
