"""A robot in simulated time: x(k+1) = f(x(k), u(k), dt) of its body, with its cameras and the real controller.

Time passes from pair to pair of images, with the ticks of the controller between them. Before the tick at a pair time
stops until the images of the pair before have been answered: `wait` of `Vehicle.pairs`. In lock-step the stages
run inline, so nothing is waited for. A daemon in other threads is waited for, so that a busy computer slows the robot
down and changes nothing else: poses take longer than a tick to the wheels, so that the next pair can be rendered while
the daemon works on the last.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import count
from queue import SimpleQueue
from typing import ClassVar, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from drivers.frame import CAMERAS, Camera, Frame
from drivers.motion import GyroSample, MotionSample, WheelSample
from drivers.motors.simulated_motor import MotionLimits, Pose, SimulatedMotor
from omnid.config import Config
from omnid.controller.controller import Controller
from omnid.controller.ipc import LONGEST_RAMP_S, TickReport
from omnid.core.control.arming import ArmRequest, ContactState, TimedSetpoint
from omnid.core.control.collision_monitor import ControllerScan
from omnid.core.control.control_law import ControlInput, ControllerPose
from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.simulation.rendering.ray_caster import Floats, Sensor, render_grey
from omnid.simulation.world import Walkers, World, clearance_m

CAMERA_HEIGHT_M: Final = 0.9  # Height of the lower viewpoint over the floor.
BASELINE_M: Final = 0.2
IMAGE_PX: Final = 512
# Radii of the horizon at scale 1 and of the mirror's rim, as a fraction of the image's width.
HORIZON = 207.5676 / 768
RIM = 373.0 / 768
TOPICS = ("/lower/image_raw/compressed", "/upper/image_raw/compressed")
# The image's centre shows the floor; up in the image is forward, and the mirror's flip is in fu < 0.
R_RIG_CAM = np.array([[0, -1.0, 0], [-1, 0, 0], [0, 0, -1]])


@dataclass(frozen=True)
class SimulatedRobot:
    """A disc with two driven wheels and two cameras; the motor controller is that of the configuration.

    Wheels are measured by a ruler, not calibrated, on a hard floor: their diameters are 1 % off and differ by 0.7 %
    (Borenstein, Feng 1996: unequal and wrong diameters, and the track, are the systematic errors). Noise adds to the
    variance in proportion to the way (Chong, Kleeman 1997): of 10 m, 6 mm of each wheel.
    """

    rig: Rig
    sensor: Sensor = field(default_factory=Sensor)
    radius_m: float = 0.2
    height_m: float = 1.2
    limits: MotionLimits = field(default_factory=lambda: MotionLimits(acceleration_mps2=1.5, lag_s=0.06))
    wheel_errors: tuple[float, float] = (0.0135, 0.0065)  # share by which left and right roll farther than configured
    wheel_noise: float = 0.002  # standard deviation of the travel of each wheel, per root of a metre [m]
    gyro_bias_radps: tuple[float, float, float] = (0.004, -0.003, 0.006)  # about base x, y, z
    gyro_noise_radps: float = 0.003  # standard deviation of a sample
    gyro_hz: float = 100.0
    rate_hz: float = 10.0  # of the cameras
    samples: int = 2  # in lock-step: rays of a pixel, per axis
    pose_delay_s: float = 0.1  # in lock-step: from the exposure to the pose's arrival at the controller


def make_robot(size_px: int = IMAGE_PX, rig: Rig | None = None) -> SimulatedRobot:
    """Return the default robot with images of that size before straight parabolic mirrors, or with another rig.

    A camera of that rig without a mask is given one, of the whole image.
    """
    if rig is not None:
        lower, upper = (replace(mounted, mask=mounted.visible) for mounted in (rig.lower, rig.upper))
        return SimulatedRobot(replace(rig, lower=lower, upper=upper))
    focal_px, centre = HORIZON * size_px, ((size_px - 1) / 2, (size_px - 1) / 2)
    camera = UnifiedCamera(1.0, (-focal_px, focal_px), centre, (size_px, size_px))
    lower, upper = (
        MountedCamera(
            camera, se3.inverse(se3.transform(R_RIG_CAM, [0.0, 0.0, height_m])), Mask(centre, 0.0, RIM * size_px)
        )
        for height_m in (0.0, BASELINE_M)
    )
    return SimulatedRobot(Rig(lower, upper, se3.transform(np.eye(3), [0.0, 0.0, CAMERA_HEIGHT_M]), TOPICS))


class SimulatedCameras:
    """Renders raw grey frames; an image follows from world, people, pose, sequence number and seed alone."""

    def __init__(self, rig: Rig, sensor: Sensor, world: World, seed: int, samples: int) -> None:
        """samples: per pixel and axis."""
        self.world, self.sensor, self.samples, self._seed = world, sensor, samples, seed
        self.mounted = {"lower": rig.lower, "upper": rig.upper}

    def frame(self, camera: Camera, seq: int, stamp_ns: int, T_world_rig: Array, people: Walkers) -> Frame:
        """Return the frame of a camera on a rig at T_world_rig (4, 4)."""
        ideal = self.ideal(camera, T_world_rig, people) * np.float32(self.world.light_at(people.time_s))
        rng = np.random.default_rng([self._seed, 43, CAMERAS.index(camera), seq])
        return Frame(
            seq, stamp_ns, camera, "mono8", self.exposed(camera, ideal, rng), *self.mounted[camera].camera.size
        )

    def exposed(self, camera: Camera, ideal: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the sensor's image (H, W) of an ideal one."""
        return self.sensor.expose(ideal, rng)

    def ideal(self, camera: Camera, T_world_rig: Array, people: Walkers) -> Floats:
        """Return the image (H, W) without the errors of a sensor."""
        return render_grey((*self.world.standing, *people.faces()), self.mounted[camera], T_world_rig, self.samples)


START_NS: Final = 1_000_000_000_000  # Start of the simulated clock.
# Messages to the controller; a stop disarms.
Message: TypeAlias = ControlInput | ContactState | Literal["stop"]


class Tick(NamedTuple):
    """The truth at a tick of the controller."""

    time_s: float  # since the start
    pose: Pose  # of the base in the world
    clearance_m: float  # of the robot's outline; 0 or less: contact


class Exposure(NamedTuple):
    """What the sensors give at a time: a pair of images, and wheels and gyro since the pair before."""

    stamp_ns: int
    frames: list[Frame]
    samples: list[MotionSample]


class Vehicle:
    """The robot. Messages to the controller arrive at their times, in order.

    What a subclass may change of it are `images`, `move` and `travel_m`: cameras that fail, pushes, wheels that slip.
    """

    make_cameras: ClassVar[type[SimulatedCameras]] = SimulatedCameras
    make_motor: ClassVar[type[SimulatedMotor]] = SimulatedMotor

    def __init__(
        self,
        world: World,
        robot: SimulatedRobot,
        config: Config,
        seed: int,
        take_tick: Callable[[Tick, TickReport], None],
        report: Callable[[float, str], None],
        start_ns: int = START_NS,
    ) -> None:
        """take_tick: takes each tick. report: takes lines of the controller, with the time since the start [s]."""
        self.world, self.robot, self.people = world, robot, Walkers(world.people)
        self._has_odometry, self._has_gyro = config.motion.wheels != "off", config.motion.imu != "off"
        self.now_ns = self._start_ns = self._tick_ns = self._gyro_ns = start_ns
        self._take_tick = take_tick
        self.cameras = self.make_cameras(robot.rig, robot.sensor, world, seed, robot.samples)
        drive = config.motor.drive
        self.motor = self.make_motor(drive, config.motor.watchdog_ms, lambda: self.now_ns)
        self.base = self.motor.base
        self.base.pose, self.base.limits, self.base.traction = world.start, robot.limits, self.travel_m
        self.controller = Controller(
            self.motor,
            # Where no obstacles are searched there is no collision monitor.
            config.controller if config.obstacles.enabled else config.controller.without_obstacles,
            1.0 / config.motor.rate_hz,
            lambda line: report(self.time_s, line),
            clock_ns=lambda: self.now_ns,
            limited=drive.limited,
        )
        self._period_ns = round(NS_PER_S / config.motor.rate_hz)
        self._posted: SimpleQueue[tuple[int, int, Message]] = SimpleQueue()  # when it is due [ns], number
        self._waiting: list[tuple[int, int, Message]] = []
        self._numbers, self._arrived_ns = count(), 0
        self._wheel_noise, self._gyro_noise = random.Random(seed), random.Random(seed + 1)
        self.samples: list[MotionSample] = []  # since the last pair
        self._obstacles = world.obstacles(robot.height_m)

    @property
    def time_s(self) -> float:
        """Return the time since the start."""
        return (self.now_ns - self._start_ns) * 1e-9

    @property
    def T_world_base(self) -> Array:
        """Return the true pose (4, 4) of the base."""
        return self.world.T_world_base(self.base.pose)

    @property
    def T_world_rig(self) -> Array:
        """Return the true pose (4, 4) of the rig."""
        return self.T_world_base @ self.robot.rig.T_base_rig

    def post(self, message: Message, due_ns: int = 0) -> None:
        """Deliver a message to the controller before its first tick at or after a time; from any thread.

        A pose or an obstacle scan arrives pose_delay_s of the robot after its images. A setpoint or a request without a
        time of arrival arrives when `advance` is called next.
        """
        if isinstance(message, ControllerPose | ControllerScan):
            due_ns = message.stamp_ns + round(self.robot.pose_delay_s * NS_PER_S)
        self._posted.put((due_ns, next(self._numbers), message))

    def pairs(self, wait: Callable[[], object]) -> Iterator[Exposure]:
        """Yield pair after pair. wait: returns when the messages that follow from the pairs before have been posted."""
        for seq in count():
            # 1. The body moves by what the controller knows; the images show it there.
            stamp_ns = self._start_ns + round(seq * NS_PER_S / self.robot.rate_hz)
            self.advance(stamp_ns, includes_end=False)
            frames = self.images(seq, stamp_ns)
            # 2. What has been answered meanwhile takes effect with the tick of now.
            wait()
            self.advance(stamp_ns)
            samples, self.samples = self.samples, []
            yield Exposure(stamp_ns, frames, samples)

    def images(self, seq: int, stamp_ns: int) -> list[Frame]:
        """Return the frames of the cameras now."""
        T_world_rig = self.T_world_rig
        return [self.cameras.frame(camera, seq, stamp_ns, T_world_rig, self.people) for camera in CAMERAS]

    def advance(self, until_ns: int, *, includes_end: bool = True) -> None:
        """Advance to a time, with all ticks and samples that are due until then.

        includes_end: also those that are due at that very time; otherwise they are left to the next call.
        """
        while not self._posted.empty():
            heapq.heappush(self._waiting, self._posted.get())
        while (due_ns := min(self._tick_ns, self._gyro_ns)) < until_ns + includes_end:
            self._elapse(due_ns)
            if due_ns == self._gyro_ns:
                self._gyro_ns += round(NS_PER_S / self.robot.gyro_hz)
            if due_ns == self._tick_ns:
                while self._waiting and self._waiting[0][0] <= self.now_ns:
                    self._deliver(heapq.heappop(self._waiting)[2])
                self._tick()
                self._tick_ns += self._period_ns
        self._elapse(until_ns)

    def come_to_rest(self) -> None:
        """Have the controller stop the wheels permanently."""
        self.controller.end()
        self.advance(self.now_ns + round(LONGEST_RAMP_S / S_PER_NS))

    def move(self, dt_s: float) -> None:
        """Move the base by its wheels until now, for a time."""
        self.motor.advance()

    def travel_m(self, dt_s: float, left_m: float, right_m: float) -> tuple[float, float]:
        """Return the travel of the left and the right wheel over the ground for that of their rims in a time."""
        sigma, noise = self.robot.wheel_noise, self._wheel_noise.gauss
        left_m, right_m = (
            travel_m * (1.0 + error) + sigma * math.sqrt(abs(travel_m)) * noise(0.0, 1.0)
            for travel_m, error in zip((left_m, right_m), self.robot.wheel_errors, strict=True)
        )
        return left_m, right_m

    def _deliver(self, message: Message) -> None:
        """Deliver a message, which arrives after all earlier messages and after the tick before."""
        self._arrived_ns = max(self._arrived_ns, self._tick_ns - self._period_ns) + 1
        if message == "stop":
            self.controller.stop(self._arrived_ns)
        elif isinstance(message, ContactState):
            self.controller.touch(message)
        elif isinstance(message, TimedSetpoint | ArmRequest) and not message.arrival_ns:
            self.controller.take(message._replace(arrival_ns=self._arrived_ns))
        else:
            self.controller.take(message)

    def _elapse(self, until_ns: int) -> None:
        """Let the time until a stamp pass: the base moves, the gyro gives the mean of its turn, people walk."""
        before, dt_s = self.base.pose, (until_ns - self.now_ns) * 1e-9
        self.now_ns = until_ns
        self.move(dt_s)
        if self._has_gyro and dt_s > 0.0:
            turned_radps = self.world.turned_rad(before, self.base.pose) / dt_s
            noise = (self.robot.gyro_noise_radps * self._gyro_noise.gauss(0.0, 1.0) for _ in range(3))
            parts = zip(self.robot.gyro_bias_radps, noise, turned_radps.tolist(), strict=True)
            self.samples.append(GyroSample(self.now_ns, *(bias + one + turned for bias, one, turned in parts)))
        self.people.advance(self.time_s, self.base.pose[:2])

    def _tick(self) -> None:
        report, status, pose = self.controller.tick(), self.motor.status, self.base.pose
        if self._has_odometry and status is not None and math.isfinite(status.velocity_mps):
            self.samples.append(WheelSample(self.now_ns, status.velocity_mps, status.yaw_rate_radps))
        walking = self.world.footprints(self.people.faces(), self.robot.height_m)
        nearest_m = min(clearance_m(one, pose[:2], self.robot.radius_m) for one in (self._obstacles, walking))
        self._take_tick(Tick(self.time_s, pose, nearest_m), report)
