"""Worlds and robots of the benchmarks: ground, sun, glass, lamps, pushes, slipping wheels, faults of the hardware."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Final, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.models.camera import Array
from drivers.errors import DriverError
from drivers.frame import Camera, Frame
from drivers.motor import MotorStatus, VelocityCommand
from drivers.motors.simulated_motor import Pose, SimulatedMotor
from omnid.config import Config
from omnid.simulation.rendering.ray_caster import Floats
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.robot import SimulatedCameras, SimulatedRobot, Vehicle
from omnid.simulation.world import Walkers, World
from tests.simulation import lockstep
from tests.simulation.disturbances import Mirror, MountedSensor, jpeg, seen_part
from tests.simulation.lockstep import Drive, SimulatedRun

HALF_BASE_M: Final = 0.15  # from the middle of the base to where its wheels and castors touch the floor
WHEEL_M: Final = 0.05  # A wheel rounds off the heights within this distance.
# The light that falls through a window with a bar each way, its edges soft.
PANES: Final = np.rint(
    cv2.GaussianBlur(np.pad(np.tile(np.pad(np.full((38, 38), 255, np.float32), 2), (2, 2)), 6), (0, 0), 2.0)
).astype(np.uint8)


@dataclass(frozen=True)
class Ground:
    """The heights of a floor, which change along x only."""

    profile: tuple[tuple[float, float], ...] = ()  # x, z [m] by x; two of one x are a step; level without any

    @cached_property
    def _points(self) -> Array:
        return np.array(self.profile).T

    def heights_m(self, x_m: Array | float) -> Array:
        """Return the heights at places along x."""
        x_m = np.asarray(x_m, float)
        return np.asarray(np.interp(x_m, *self._points)) if self.profile else np.zeros_like(x_m)


@dataclass(frozen=True, slots=True)
class SunPatch:
    """A patch of sun on the level floor, which moves to and fro, and fades behind clouds."""

    at: tuple[float, float]  # its middle at 0 s
    size_m: tuple[float, float]
    yaw_rad: float
    velocity_mps: tuple[float, float]
    gain: float  # by which the floor is brighter

    def rectangle(self, time_s: float) -> Rectangle:
        """Return the patch just above the floor."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        u, v = np.array([c, s, 0.0]) * self.size_m[0], np.array([s, -c, 0.0]) * self.size_m[1]
        middle = np.array([*(at + time_s * v_mps for at, v_mps in zip(self.at, self.velocity_mps, strict=True)), 2e-3])
        return Rectangle(middle - (u + v) / 2, u, v, PANES, "sun")


@dataclass(frozen=True)
class BuildingWorld(World):
    """A world whose floor is at z = 0 where the ground does not say otherwise."""

    ground: Ground = Ground()
    is_polished: bool = False  # the floor mirrors the objects on it
    edges: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))  # [m] where the floor falls
    panes: tuple[Rectangle, ...] = ()  # of glass: seen by what they mirror, and touched
    sun: tuple[SunPatch, ...] = ()
    lights: tuple[tuple[float, float], ...] = ()  # time [s] from which on a factor on all greys holds

    def T_world_base(self, pose: Pose) -> Array:
        """Return the pose (4, 4) of a base that stands there; x, y and heading are those of its middle."""
        T = super().T_world_base(pose)
        if self.ground.profile:
            c, s = HALF_BASE_M * math.cos(pose[2]), HALF_BASE_M * math.sin(pose[2])
            around = pose[0] + np.array([c, -c, -s, s])[:, None] + np.linspace(-WHEEL_M, WHEEL_M, 5)
            heights_m = self.ground.heights_m(around).mean(axis=1).tolist()
            pitch_rad, roll_rad = (math.atan2(a - b, 2 * HALF_BASE_M) for a, b in (heights_m[:2], heights_m[2:]))
            T = T @ se3.transform(se3.rotation_exp([0.0, -pitch_rad, 0.0]), [0.0, 0.0, sum(heights_m) / 4])
            T = T @ se3.transform(se3.rotation_exp([roll_rad, 0.0, 0.0]), np.zeros(3))
        return T

    def turned_rad(self, before: Pose, now: Pose) -> Array:
        """Return the rotation vector (3,) of a base between two poses, in its own frame."""
        if not self.ground.profile:
            return super().turned_rad(before, now)
        return se3.rotation_log((se3.inverse(self.T_world_base(before)) @ self.T_world_base(now))[:3, :3])

    def light_at(self, time_s: float) -> float:
        """Return the factor on the grey of all images."""
        factors = [factor for begin_s, factor in self.lights if begin_s <= time_s]
        return self.brightness * (factors[-1] if factors else 1.0)

    def footprints(self, rectangles: Sequence[Rectangle], height_m: float) -> Array:
        """Return the outlines (N, 2, 2) [m] of rectangles; heights count from the ground below."""
        down_m = [float(self.ground.heights_m(rectangle.corners[:, 0].mean())) for rectangle in rectangles]
        lowered = [
            replace(rectangle, origin=rectangle.origin - (0.0, 0.0, z_m)) if z_m else rectangle
            for rectangle, z_m in zip(rectangles, down_m, strict=True)
        ]
        return super().footprints(lowered, height_m)

    def obstacles(self, height_m: float) -> Array:
        """Return the segments (N, 2, 2) of all that stands, of the panes, and of the edges of the floor."""
        return np.concatenate([self.footprints((*self.standing, *self.panes), height_m), self.edges])


class BuildingCameras(SimulatedCameras):
    """Cameras that see glass, sun and darkness, too."""

    is_dark = False

    @cached_property
    def sensors(self) -> dict[str, MountedSensor]:
        """The sensor of each camera with what is before it."""
        return {
            name: MountedSensor(self.sensor, mounted.visible, mounted.camera.size)
            for name, mounted in self.mounted.items()
        }

    @cached_property
    def mirrors(self) -> dict[str, Mirror]:
        """What each camera sees in mirrors."""
        return {name: Mirror(mounted) for name, mounted in self.mounted.items()}

    def ideal(self, camera: Camera, T_world_rig: Array, people: Walkers) -> Floats:
        """Return the image (H, W) without the errors of a sensor."""
        ideal, world = super().ideal(camera, T_world_rig, people), self.world
        if isinstance(world, BuildingWorld):
            scene = Scene((*world.standing, *people.faces()))
            for mirror in (*[next(face for face in scene if face.name == "floor")][: world.is_polished], *world.panes):
                ideal = self.mirrors[camera].reflected(ideal, scene, mirror, T_world_rig, self.samples)
            for patch in world.sun:
                lit = patch.rectangle(people.time_s)
                shown = seen_part(lit, scene, self.mounted[camera], T_world_rig, self.samples)
                ideal = np.asarray(ideal * (1 + np.float32(patch.gain) * shown), np.float32)
        return ideal * np.float32(not self.is_dark)

    def exposed(self, camera: Camera, ideal: Floats, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the image (H, W) of a sensor with what is before it."""
        return self.sensors[camera].expose(ideal, rng)

    def frame(self, camera: Camera, seq: int, stamp_ns: int, T_world_rig: Array, people: Walkers) -> Frame:
        """Return the frame of a camera on a rig at T_world_rig (4, 4)."""
        frame = super().frame(camera, seq, stamp_ns, T_world_rig, people)
        if not self.sensors[camera].sensor.is_compressed:
            return frame
        return replace(frame, encoding="jpeg", data=jpeg(np.asarray(frame.data)))


@dataclass(frozen=True, slots=True)
class Slip:
    """A time [s] in which the driven wheels move the robot by a smaller share of their travel."""

    start_s: float
    end_s: float
    share: float  # that is lost


@dataclass(frozen=True, slots=True)
class Push:
    """A time [s] in which somebody pushes the base aside."""

    start_s: float
    end_s: float
    sideways_mps: float
    yaw_rate_radps: float = 0.0


@dataclass(frozen=True)
class DisturbedRobot(SimulatedRobot):
    """A robot that slips, is pushed, or leans."""

    slips: tuple[Slip, ...] = ()
    pushes: tuple[Push, ...] = ()
    lean_rad: tuple[float, float] = (0.0, 0.0)  # roll and pitch by which the base leans, which its rig does not say


def disturbed(robot: SimulatedRobot, **changes: object) -> DisturbedRobot:
    """Return a robot with changes of its fields, or of those of DisturbedRobot."""
    return DisturbedRobot(**(vars(robot) | changes))


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the surroundings or of the hardware, between two times [s] since the start of the drive."""

    kind: Literal["dark", "no lower image", "no upper image", "motor cut"]
    start_s: float
    end_s: float


# Changes the pixels of a frame on its way to the stages: a fault of a camera, its driver or its mirror. The first
# argument is the time of the frame since the start [s].
Tamper: TypeAlias = Callable[[float, Frame], Frame]


class CuttableMotor(SimulatedMotor):
    """A motor controller that gets no command while its line is cut."""

    cut = False

    def send(self, command: VelocityCommand) -> MotorStatus:
        """Command a motion and return the controller's status before it; DriverError where the line is cut."""
        if self.cut:
            self.advance()
            self.status = None
            raise DriverError("the simulated motor controller gave no answer")
        return super().send(command)

    def close(self) -> None:
        """Stop the wheels."""
        self.cut = False
        super().close()


class DisturbedVehicle(Vehicle):
    """A vehicle with what disturbs its robot, and faults."""

    make_cameras: ClassVar[type[SimulatedCameras]] = BuildingCameras
    make_motor: ClassVar[type[SimulatedMotor]] = CuttableMotor
    robot: DisturbedRobot

    def __init__(self, faults: Iterable[Fault], tamper: Tamper | None, world: World, robot: SimulatedRobot, *args: Any):
        """args: as for Vehicle."""
        self.faults, self.tamper, self.rolled_s = (
            tuple(faults),
            tamper,
            0.0,
        )  # time that the wheels have turned or stood
        super().__init__(world, disturbed(robot), *args)

    @property
    def T_world_rig(self) -> Array:
        """Return the true pose (4, 4) of the rig, which may lean otherwise than its file says."""
        T_lean = se3.transform(se3.rotation_exp([*self.robot.lean_rad, 0.0]), np.zeros(3))
        return self.T_world_base @ T_lean @ self.robot.rig.T_base_rig

    def _has(self, kind: str) -> bool:
        return any(fault.kind == kind and fault.start_s <= self.time_s < fault.end_s for fault in self.faults)

    def images(self, seq: int, stamp_ns: int) -> list[Frame]:
        """Return the frames that a fault does not take away."""
        assert isinstance(self.cameras, BuildingCameras) and isinstance(self.motor, CuttableMotor)
        self.motor.cut, self.cameras.is_dark = self._has("motor cut"), self._has("dark")
        frames = [one for one in super().images(seq, stamp_ns) if not self._has(f"no {one.camera} image")]
        return frames if self.tamper is None else [self.tamper(self.time_s, frame) for frame in frames]

    def move(self, dt_s: float) -> None:
        """Move the base by its wheels, and by who pushes it."""
        begin_s = self.time_s - dt_s
        super().move(dt_s)
        for push in self.robot.pushes:
            if push.start_s <= begin_s < push.end_s:
                x_m, y_m, heading_rad = self.base.pose
                aside_m = push.sideways_mps * dt_s
                x_m, y_m = x_m - aside_m * math.sin(heading_rad), y_m + aside_m * math.cos(heading_rad)
                self.base.pose = x_m, y_m, heading_rad + push.yaw_rate_radps * dt_s

    def travel_m(self, dt_s: float, left_m: float, right_m: float) -> tuple[float, float]:
        """Return the travel of both wheels over the plane: they slip, and over a slope it is less."""
        self.rolled_s += dt_s
        slips = [slip for slip in self.robot.slips if slip.start_s <= self.rolled_s < slip.end_s]
        kept = 1.0 - max((slip.share for slip in slips), default=0.0)
        left_m, right_m = super().travel_m(dt_s, kept * left_m, kept * right_m)
        if not (isinstance(self.world, BuildingWorld) and self.world.ground.profile):
            return left_m, right_m
        along = np.array([math.cos(self.base.pose[2]), math.sin(self.base.pose[2])])
        cosine = float(self.T_world_base[:2, 0] @ along)
        return cosine * left_m, cosine * right_m


def simulate(
    world: World,
    robot: SimulatedRobot,
    drive: Drive,
    *,
    seconds: float,
    seed: int = 0,
    config: Config | None = None,
    faults: Iterable[Fault] = (),
    tamper: Tamper | None = None,
) -> SimulatedRun:
    """Drive in lock-step as omnid's own `simulate`, with what disturbs robot and world; tamper: changes the images."""
    vehicle = partial(DisturbedVehicle, faults, tamper)
    return lockstep.simulate(world, robot, drive, seconds=seconds, seed=seed, config=config, vehicle=vehicle)


def least_clearance_m(run: SimulatedRun) -> float:
    """Return the smallest distance of the robot's outline to an obstacle [m]; 0 or less: contact."""
    return min(tick.clearance_m for tick in run.ticks)
