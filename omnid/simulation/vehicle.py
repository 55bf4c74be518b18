"""A robot in simulated time: x(k+1) = f(x(k), u(k), dt) of its body, with its cameras and the real controller.

Time passes from pair to pair of images, with the ticks of the controller between them. Before the tick at a pair time
stands still until the images of the pair before have been answered: `wait` of `Vehicle.pairs`. In lock-step the stages
run inline, so nothing is waited for. A daemon in other threads is waited for, so that a busy computer slows the robot
down and changes nothing else: poses take longer than a tick to the wheels, so that the next pair can be rendered while
the daemon works on the last.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from queue import SimpleQueue
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib import se3
from drivers.frame import CAMERAS, Frame
from drivers.motion import GyroSample, MotionSample, WheelSample
from drivers.motor import VelocityCommand
from drivers.motors.simulated.simulated_base import Pose
from drivers.motors.simulated.simulated_motor import SimulatedMotor
from omnid.config import Config
from omnid.controller.controller import Controller
from omnid.controller.statistics import TickReport
from omnid.core.control.arming import ArmRequest
from omnid.core.control.command_sources import TimedSetpoint
from omnid.core.control.contacts import ContactState
from omnid.core.control.control_law import ControlInput
from omnid.simulation.cameras import SimulatedCameras
from omnid.simulation.clearance import clearance_m, footprints, obstacles_of
from omnid.simulation.people import Walkers
from omnid.simulation.robot import SimulatedRobot, with_masks
from omnid.simulation.world import World

Array = NDArray[np.float64]
START_NS: Final = 1_000_000_000_000  # Start of the simulated clock.
STOPPING_NS: Final = 2_000_000_000  # At the end the wheels come to rest within this time.
# What a controller is given; a stop disarms.
Given: TypeAlias = ControlInput | ContactState | Literal["stop"]


class Tick(NamedTuple):
    """The truth at a tick of the controller."""

    time_s: float  # since the start
    pose: Pose  # of the base in the world
    command: VelocityCommand | None  # that was sent; None where the motor controller did not answer
    reason: str  # why the wheels must stop; empty where they may turn
    clearance_m: float  # of the robot's outline; 0 or less: contact


class Exposure(NamedTuple):
    """What the sensors give at a time: a pair of images, and wheels and gyro since the pair before."""

    stamp_ns: int
    frames: list[Frame]
    samples: list[MotionSample]


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the surroundings or of the hardware, between two times [s] since the start of the drive."""

    kind: Literal["dark", "no lower image", "no upper image", "motor cut"]
    start_s: float
    end_s: float


class Vehicle:
    """The robot. Messages to the controller arrive at their times, in order."""

    def __init__(
        self,
        world: World,
        robot: SimulatedRobot,
        config: Config,
        seed: int,
        take_tick: Callable[[Tick, TickReport], None],
        report: Callable[[float, str], None],
        start_ns: int = START_NS,
        *,
        samples: int | None = None,
        faults: Iterable[Fault] = (),
    ) -> None:
        """take_tick: takes each tick. report: takes lines of the controller, with the time since the start [s].

        samples: rays of a pixel, per axis; None: those of the robot.
        """
        self.now_ns = self._start_ns = start_ns
        self.people = Walkers(world.people)
        self._take_tick = take_tick
        self._ground, self._robot, self._faults = world.ground, robot, tuple(faults)
        rays = robot.samples if samples is None else samples
        self._cameras = SimulatedCameras(with_masks(robot.rig), robot.sensor, world, seed, rays)
        drive = config.motor.drive.geometry()
        self.motor = SimulatedMotor(drive, config.motor.watchdog_ms, lambda: self.now_ns)
        self.base = self.motor.base
        self.base.pose, self.base.limits, self.base.traction = world.start, robot.limits, self._over_ground
        self.controller = Controller(
            self.motor,
            config.controller,
            1.0 / config.motor.rate_hz,
            lambda line: report(self.time_s, line),
            clock_ns=lambda: self.now_ns,
            limited=drive.limited,
        )
        self._period_ns = round(1e9 / config.motor.rate_hz)
        self._tick_ns = start_ns
        self._posted: SimpleQueue[tuple[int, int, Given]] = SimpleQueue()  # when it is due [ns], number
        self._waiting: list[tuple[int, int, Given]] = []
        self._numbers, self._arrived_ns = count(), 0
        self._wheel_noise, self._gyro_noise = random.Random(seed), random.Random(seed + 1)
        self._rolled_s = 0.0  # time that the wheels have turned or stood
        self._gyro_ns = start_ns
        self.samples: list[MotionSample] = []  # since the last pair
        self._standing = obstacles_of(world, robot.height_m)

    @property
    def time_s(self) -> float:
        """Return the time since the start."""
        return (self.now_ns - self._start_ns) * 1e-9

    @property
    def T_world_base(self) -> Array:
        """Return the true pose (4, 4) of the base."""
        return self._ground.T_world_base(self.base.pose)

    @property
    def T_world_rig(self) -> Array:
        """Return the true pose (4, 4) of the rig, which may lean otherwise than its file says."""
        return self.T_world_base @ self._robot.T_base_leaning @ self._robot.rig.T_base_rig

    def post(self, given: Given, due_ns: int = 0) -> None:
        """Have the controller given something before its first tick at or after a time; from any thread.

        It is on its way when `advance` is called next. A setpoint or a request without a time of arrival arrives then.
        """
        self._posted.put((due_ns, next(self._numbers), given))

    def pairs(self, wait: Callable[[], object]) -> Iterator[Exposure]:
        """Yield pair after pair, without the images that a fault takes away.

        wait: returns when the messages that follow from the pairs before have been posted.
        """
        for seq in count():
            # 1. The body moves by what the controller knows; the images show it there.
            stamp_ns = self._start_ns + round(seq * 1e9 / self._robot.rate_hz)
            self.motor.cut = self._has("motor cut")
            self.advance(stamp_ns, ticks_then=False)
            brightness = 0.0 if self._has("dark") else 1.0
            frames = [
                self._cameras.frame(camera, seq, stamp_ns, self.T_world_rig, self.people, brightness=brightness)
                for camera in CAMERAS
                if not self._has(f"no {camera} image")
            ]
            # 2. What has been answered meanwhile takes effect with the tick of now.
            wait()
            self.advance(stamp_ns)
            samples, self.samples = self.samples, []
            yield Exposure(stamp_ns, frames, samples)

    def _has(self, kind: str) -> bool:
        """True while there is a fault of this kind."""
        return any(fault.kind == kind and fault.start_s <= self.time_s < fault.end_s for fault in self._faults)

    def advance(self, until_ns: int, *, ticks_then: bool = True) -> None:
        """Advance to a time, with all ticks and samples that are due until then.

        ticks_then: those that are due just then, too; otherwise the next call gives them.
        """
        while not self._posted.empty():
            heapq.heappush(self._waiting, self._posted.get())
        while (due_ns := min(self._tick_ns, self._gyro_ns)) < until_ns + ticks_then:
            self._move(due_ns)
            if due_ns == self._gyro_ns:
                self._gyro_ns += round(1e9 / self._robot.gyro.rate_hz)
            if due_ns == self._tick_ns:
                while self._waiting and self._waiting[0][0] <= self.now_ns:
                    self._give(heapq.heappop(self._waiting)[2])
                self._tick()
                self._tick_ns += self._period_ns
        self._move(until_ns)

    def come_to_rest(self) -> None:
        """Have the controller stop the wheels permanently."""
        self.controller.end()
        self.advance(self.now_ns + STOPPING_NS)

    def _give(self, given: Given) -> None:
        """Give the controller something, which arrives after what it was given before, and after the tick before."""
        self._arrived_ns = max(self._arrived_ns, self._tick_ns - self._period_ns) + 1
        if given == "stop":
            self.controller.stop(self._arrived_ns)
        elif isinstance(given, ContactState):
            self.controller.touch(given)
        elif isinstance(given, TimedSetpoint | ArmRequest) and not given.arrival_ns:
            self.controller.take(given._replace(arrival_ns=self._arrived_ns))
        else:
            self.controller.take(given)

    def _move(self, until_ns: int) -> None:
        base, begin_s, dt_s = self.base, self.time_s, (until_ns - self.now_ns) * 1e-9
        before, self.now_ns = base.pose, until_ns
        self.motor.advance()
        for push in self._robot.pushes:
            if push.start_s <= begin_s < push.end_s:
                x_m, y_m, heading_rad = base.pose
                aside_m = push.sideways_mps * dt_s
                x_m, y_m = x_m - aside_m * math.sin(heading_rad), y_m + aside_m * math.cos(heading_rad)
                base.pose = x_m, y_m, heading_rad + push.yaw_rate_radps * dt_s
        if self._robot.has_gyro and dt_s > 0.0:
            self._sense_rotation(self._turned(before, base.pose) / dt_s)
        self.people.advance(self.time_s, base.pose[:2])

    def _turned(self, before: Pose, now: Pose) -> Array:
        """Return the rotation vector (3,) of the base between two poses, in its own frame."""
        if not self._ground.profile:
            return np.array([0.0, 0.0, math.remainder(now[2] - before[2], math.tau)])
        return se3.rotation_log(
            (se3.inverse(self._ground.T_world_base(before)) @ self._ground.T_world_base(now))[:3, :3]
        )

    def _over_ground(self, dt_s: float, left_m: float, right_m: float) -> tuple[float, float]:
        """Return the travel of both wheels over the plane: they slip, and over a slope it is less."""
        wheels, ground, pose = self._robot.wheels, self._ground, self.base.pose
        noise = self._wheel_noise.gauss
        self._rolled_s += dt_s
        lost = [slip.share for slip in wheels.slips if slip.start_s <= self._rolled_s < slip.end_s]
        kept = 1.0 - max(lost, default=0.0)
        left_m, right_m = (
            kept * travel_m * (1.0 + error) + wheels.noise * math.sqrt(abs(travel_m)) * noise(0.0, 1.0)
            for travel_m, error in ((left_m, wheels.left), (right_m, wheels.right))
        )
        if not ground.profile:
            return left_m, right_m
        cosine = float(ground.T_world_base(pose)[:2, 0] @ np.array([math.cos(pose[2]), math.sin(pose[2])]))
        return cosine * left_m, cosine * right_m

    def _sense_rotation(self, rates_radps: Array) -> None:
        """Add a sample of the gyro: the mean over the time since the last one."""
        errors = self._robot.gyro
        noise = [errors.noise_radps * self._gyro_noise.gauss(0.0, 1.0) for _ in range(3)]
        x, y, z = (bias + wrong for bias, wrong in zip(errors.bias_radps, noise, strict=True))
        about_x, about_y, about_z = rates_radps.tolist()
        self.samples.append(GyroSample(self.now_ns, x + about_x, y + about_y, z + about_z))

    def _tick(self) -> None:
        report = self.controller.tick()
        status = self.motor.status
        if self._robot.has_odometry and status is not None and math.isfinite(status.velocity_mps):
            self.samples.append(WheelSample(self.now_ns, status.velocity_mps, status.yaw_rate_radps))
        self._take_tick(
            Tick(self.time_s, self.base.pose, report.command, report.state.reason, self._clearance_m()), report
        )

    def _clearance_m(self) -> float:
        x_m, y_m, _ = self.base.pose
        walking = footprints(self.people.faces(), self._robot.height_m, self._ground)
        return min(clearance_m(segments, (x_m, y_m), self._robot.radius_m) for segments in (self._standing, walking))
