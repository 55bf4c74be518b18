"""A base with two driven wheels as pure state: what it is told, its watchdogs, its way; time passes by `advance`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import DriverError
from drivers.motor import VelocityCommand
from drivers.motors.differential_drive import DifferentialDrive
from drivers.motors.motor_protocol import Framer

STEP_S = 0.005
LONGEST_ADVANCE_S = 60.0
LEFT, RIGHT = SIDES = (0, 1)
Pose = tuple[float, float, float]  # x [m], y [m], heading [rad]


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What the wheels can do."""

    acceleration_mps2: float = 2.0
    yaw_rate_radps: float = 2.0
    yaw_acceleration_radps2: float = 8.0
    heading_gain_hz: float = 3.0


class SimulatedBase:
    """Wheels behind a controller. Each has its own watchdog; one that was stopped by it owes a zero before it moves.

    A controller counts its valid commands in `commands` and everything that a real one would complain of in `errors`.
    """

    def __init__(self, drive: DifferentialDrive | None = None, limits: MotionLimits | None = None) -> None:
        self.drive = drive or DifferentialDrive()
        self.commands = self.errors = 0
        self.expiries = 0  # times the watchdog has stopped the wheels
        self.unsafe_resumes = 0  # motion told to a side that owed a zero
        self.watchdog_ms = 500.0  # 0 is off
        self.fault = 0
        self.battery_v = 12.0
        self.pose: Pose = (0.0, 0.0, 0.0)
        self.velocity_mps = self.yaw_rate_radps = 0.0
        self.travel_m = [0.0, 0.0]  # of the wheels
        self.goal_heading_rad: float | None = None  # in the world: steered to while it moves, for what can
        self.commanded_mps = [0.0, 0.0]
        self.expired = [False, False]
        self._needs_stop = [False, False]
        self._since_command_s = [0.0, 0.0]
        self.limits = limits or MotionLimits()

    @property
    def watchdog_expired(self) -> bool:
        """Whether a watchdog holds a wheel."""
        return any(self.expired)

    @property
    def last_command(self) -> VelocityCommand:
        """The motion that was told last, with stamp and heading 0."""
        velocity_mps, yaw_rate_radps = self._twist(*self.commanded_mps)
        return VelocityCommand(0, velocity_mps, 0.0, yaw_rate_radps)

    def command(self, velocity_mps: float, yaw_rate_radps: float) -> None:
        """A motion for both wheels."""
        half_mps = yaw_rate_radps * self.drive.track_m / 2
        self.command_wheel(LEFT, velocity_mps - half_mps)
        self.command_wheel(RIGHT, velocity_mps + half_mps)

    def command_channels(self, first_mps: float, second_mps: float) -> None:
        """Speeds for both motors, as they are wired."""
        for side, speed_mps in zip(SIDES, self.drive.sides(first_mps, second_mps), strict=True):
            self.command_wheel(side, speed_mps)

    def command_channel(self, channel: int, speed_mps: float) -> None:
        """A speed for one motor, 0 or 1, as it is wired."""
        side = RIGHT if bool(channel) != self.drive.swapped else LEFT
        self.command_wheel(side, self.drive.sides(speed_mps, speed_mps)[side])

    def command_wheel(self, side: int, speed_mps: float) -> None:
        """A speed for one wheel, forward positive; feeds its watchdog."""
        if self._needs_stop[side] and speed_mps != 0.0:
            self.unsafe_resumes += 1
            self.errors += 1
        self._needs_stop[side] = self.expired[side] = False
        self.commanded_mps[side] = speed_mps
        self.feed(side)

    def feed(self, side: int) -> None:
        """Feeds the watchdog of one wheel."""
        self._since_command_s[side] = 0.0

    def channels_mps(self) -> tuple[float, float]:
        """The motors' speeds as they are wired."""
        half_mps = self.yaw_rate_radps * self.drive.track_m / 2
        return self._wired(self.velocity_mps - half_mps, self.velocity_mps + half_mps)

    def channels_m(self) -> tuple[float, float]:
        """The motors' ways as they are wired."""
        return self._wired(*self.travel_m)

    def expire(self) -> None:
        """Both watchdogs stop the wheels now."""
        self.expiries += not self.watchdog_expired
        for side in SIDES:
            self._stop(side)

    def advance(self, dt_s: float) -> None:
        """Lets the time dt_s pass in small steps: watchdogs, wheels, pose."""
        if not 0.0 <= dt_s <= LONGEST_ADVANCE_S:
            raise DriverError(f"the twin cannot advance by {dt_s} s; give 0 to {LONGEST_ADVANCE_S:g} s")
        steps = math.ceil(dt_s / STEP_S)
        for _ in range(steps):
            self._step(dt_s / steps)

    def _stop(self, side: int) -> None:
        self.expired[side] = self._needs_stop[side] = True
        self.commanded_mps[side] = 0.0

    def _step(self, dt_s: float) -> None:
        self._watch(dt_s)
        velocity_mps, yaw_rate_radps = self._twist(*self.commanded_mps)
        self.velocity_mps += _clamp(velocity_mps - self.velocity_mps, self.limits.acceleration_mps2 * dt_s)
        wanted_radps = _clamp(self._steered(yaw_rate_radps), self.limits.yaw_rate_radps)
        self.yaw_rate_radps += _clamp(wanted_radps - self.yaw_rate_radps, self.limits.yaw_acceleration_radps2 * dt_s)
        self._roll(dt_s)

    def _watch(self, dt_s: float) -> None:
        before = self.watchdog_expired
        for side in SIDES:
            self._since_command_s[side] += dt_s
            if 0.0 < self.watchdog_ms < self._since_command_s[side] * 1000 and not self.expired[side]:
                self._stop(side)
        self.expiries += self.watchdog_expired and not before

    def _steered(self, yaw_rate_radps: float) -> float:
        """The yaw rate towards the heading that is wanted, where there is one and the base is to move."""
        if self.goal_heading_rad is None or self.commanded_mps == [0.0, 0.0]:
            return yaw_rate_radps
        return self.limits.heading_gain_hz * _wrap(self.goal_heading_rad - self.pose[2])

    def _roll(self, dt_s: float) -> None:
        """Moves the pose along the chord of the arc."""
        x_m, y_m, heading_rad = self.pose
        turn_rad, way_m = self.yaw_rate_radps * dt_s, self.velocity_mps * dt_s
        chord_rad = heading_rad + turn_rad / 2
        self.travel_m[LEFT] += way_m - turn_rad * self.drive.track_m / 2
        self.travel_m[RIGHT] += way_m + turn_rad * self.drive.track_m / 2
        x_m, y_m = x_m + way_m * math.cos(chord_rad), y_m + way_m * math.sin(chord_rad)
        self.pose = (x_m, y_m, _wrap(heading_rad + turn_rad))

    def _twist(self, left_mps: float, right_mps: float) -> tuple[float, float]:
        return (left_mps + right_mps) / 2, (right_mps - left_mps) / self.drive.track_m

    def _wired(self, left: float, right: float) -> tuple[float, float]:
        left, right = -left if self.drive.reverse_left else left, -right if self.drive.reverse_right else right
        return (right, left) if self.drive.swapped else (left, right)


def reply_to(base: SimulatedBase, framer: Framer, handle: Callable[[bytes], bytes], data: bytes) -> bytes:
    """What a controller answers to all frames that end in data; bytes that are of none are errors."""
    before = framer.garbage
    answer = b"".join(handle(frame) for frame in framer.feed(data))
    base.errors += framer.garbage - before
    return answer


def _clamp(value: float, magnitude: float) -> float:
    return max(-magnitude, min(magnitude, value))


def _wrap(angle_rad: float) -> float:
    return math.remainder(angle_rad, math.tau)
