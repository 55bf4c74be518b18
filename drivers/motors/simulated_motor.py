"""A simulated base with two driven wheels: commands, watchdog, motion; and the driver of its motor controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from drivers.motor import MotorStatus, VelocityCommand, is_stop, stop_command
from drivers.motors.protocols.motor_protocol import DifferentialDrive

STEP_S = 0.005  # Step of the integration.
REACHED = 1e-3  # m/s or rad/s: friction ends the lag
Pose = tuple[float, float, float]  # x [m], y [m], heading [rad]
# Travel over the ground [m] of the left and the right wheel for a time [s] and the travel of their rims.
Traction = Callable[[float, float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Limits of the motion, and the gain of the heading controller."""

    acceleration_mps2: float = 2.0
    yaw_rate_radps: float = 2.0
    yaw_acceleration_radps2: float = 8.0
    heading_gain_hz: float = 3.0  # yaw rate per heading error
    lag_s: float = 0.0  # time constant with which the speeds follow the commands


class SimulatedBase:
    """Wheels of a simulated controller with a watchdog; its time is advanced by the caller."""

    def __init__(self, drive: DifferentialDrive, watchdog_ms: float) -> None:
        self.drive, self.watchdog_ms = drive, watchdog_ms
        self.pose: Pose = (0.0, 0.0, 0.0)
        self.velocity_mps = self.yaw_rate_radps = 0.0
        self.goal_heading_rad: float | None = None  # in the world; steered to during motion, if set
        self.commanded_mps = [0.0, 0.0]  # left, right
        self.watchdog_expired = False  # it has stopped the wheels
        self._since_command_s = 0.0
        self.limits = MotionLimits()
        self.traction: Traction = lambda _, left_m, right_m: (left_m, right_m)

    def command(self, velocity_mps: float, yaw_rate_radps: float) -> None:
        """Command a motion of the base, and feed the watchdog."""
        half_mps = yaw_rate_radps * self.drive.track_m / 2
        self.commanded_mps = [velocity_mps - half_mps, velocity_mps + half_mps]
        self.watchdog_expired, self._since_command_s = False, 0.0

    def advance(self, dt_s: float) -> None:
        """Advance watchdog, wheels and pose by dt_s."""
        steps = math.ceil(dt_s / STEP_S)
        for _ in range(steps):
            self._step(dt_s / steps)

    def _step(self, dt_s: float) -> None:
        # 1. The watchdog.
        self._since_command_s += dt_s
        if self._since_command_s * 1000 > self.watchdog_ms:
            self.watchdog_expired, self.commanded_mps = True, [0.0, 0.0]
        # 2. The speeds; the yaw rate towards the goal heading, if there is one and the base does not stop.
        velocity_mps, yaw_rate_radps = self._twist(*self.commanded_mps)
        limits = self.limits
        if self.goal_heading_rad is not None and self.commanded_mps != [0.0, 0.0]:
            error_rad = math.remainder(self.goal_heading_rad - self.pose[2], math.tau)
            yaw_rate_radps = limits.heading_gain_hz * error_rad
        self.velocity_mps += self._step_to(velocity_mps - self.velocity_mps, limits.acceleration_mps2, dt_s)
        wanted_radps = _clamp(yaw_rate_radps, limits.yaw_rate_radps)
        self.yaw_rate_radps += self._step_to(wanted_radps - self.yaw_rate_radps, limits.yaw_acceleration_radps2, dt_s)
        # 3. The pose, along the chord of the arc that the wheels travel over the ground.
        x_m, y_m, heading_rad = self.pose
        half_m = self.yaw_rate_radps * dt_s * self.drive.track_m / 2
        rims_m = self.velocity_mps * dt_s - half_m, self.velocity_mps * dt_s + half_m
        distance_m, rotation_rad = self._twist(*self.traction(dt_s, *rims_m))
        chord_rad = heading_rad + rotation_rad / 2
        x_m, y_m = x_m + distance_m * math.cos(chord_rad), y_m + distance_m * math.sin(chord_rad)
        self.pose = (x_m, y_m, math.remainder(heading_rad + rotation_rad, math.tau))

    def _step_to(self, difference: float, acceleration: float, dt_s: float) -> float:
        """Return the change of a speed towards a commanded one, with lag and limited acceleration."""
        lag_s = self.limits.lag_s
        if lag_s and abs(difference) > REACHED:
            difference *= 1.0 - math.exp(-dt_s / lag_s)
        return _clamp(difference, acceleration * dt_s)

    def _twist(self, left_mps: float, right_mps: float) -> tuple[float, float]:
        return (left_mps + right_mps) / 2, (right_mps - left_mps) / self.drive.track_m


class SimulatedMotor:
    """A MotorDriver of a controller that holds headings, whose base moves as time passes by a clock.

    Like the serial driver it sends a stop in place of the first command after the watchdog has stopped the wheels.
    """

    def __init__(self, drive: DifferentialDrive, watchdog_ms: int, clock_ns: Callable[[], int]) -> None:
        self.base, self._clock_ns = SimulatedBase(drive, watchdog_ms), clock_ns
        self._now_ns = clock_ns()
        self.status: MotorStatus | None = None  # the last reply

    def advance(self) -> None:
        """Let the base move until now."""
        now_ns = self._clock_ns()
        self.base.advance((now_ns - self._now_ns) * 1e-9)
        self._now_ns = now_ns

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Command a motion and return the controller's status before it."""
        self.advance()
        base = self.base
        velocity_mps, yaw_rate_radps = base.drive.limited(command)
        self.status = MotorStatus(
            base.velocity_mps, base.pose[2], base.yaw_rate_radps, base.watchdog_expired, fault=0, battery_v=12.0
        )
        steers = not is_stop(command) and not base.watchdog_expired
        base.goal_heading_rad = command.heading_rad if steers else None
        base.command(velocity_mps * steers, yaw_rate_radps * steers)
        return self.status

    def close(self) -> None:
        """Stop the wheels."""
        self.send(stop_command(0))


def _clamp(value: float, magnitude: float) -> float:
    return max(-magnitude, min(magnitude, value))
