"""A simulated world: what stands and walks in it, the heights of its floor, its light, and what mirrors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from calib import se3
from calib.models.camera import Array
from drivers.motors.simulated.simulated_base import Pose
from omnid.simulation.people import Person
from omnid.simulation.rendering.surfaces import Rectangle, Texture

HALF_BASE_M: Final = 0.15  # from the middle of the base to where its wheels and castors touch the floor
WHEEL_M: Final = 0.05  # A wheel rounds off the heights within this distance.


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

    def T_world_base(self, pose: Pose) -> Array:
        """Return the pose (4, 4) of a base that stands there; x, y and heading are those of its middle."""
        x_m, y_m, heading_rad = pose
        R, z_m = se3.rotation_exp([0.0, 0.0, heading_rad]), 0.0
        if self.profile:
            c, s = HALF_BASE_M * math.cos(heading_rad), HALF_BASE_M * math.sin(heading_rad)
            around = x_m + np.array([c, -c, -s, s])[:, None] + np.linspace(-WHEEL_M, WHEEL_M, 5)
            front, rear, left, right = (float(height_m) for height_m in self.heights_m(around).mean(axis=1))
            z_m = (front + rear + left + right) / 4
            pitch_rad, roll_rad = (math.atan2(a - b, 2 * HALF_BASE_M) for a, b in ((front, rear), (left, right)))
            R = R @ se3.rotation_exp([0.0, -pitch_rad, 0.0]) @ se3.rotation_exp([roll_rad, 0.0, 0.0])
        return se3.transform(R, [x_m, y_m, z_m])


@dataclass(frozen=True, slots=True)
class SunPatch:
    """A patch of sun on the level floor, which moves to and fro, and fades behind clouds."""

    at: tuple[float, float]  # its middle at 0 s
    size_m: tuple[float, float]
    yaw_rad: float
    velocity_mps: tuple[float, float]
    gain: float  # by which the floor is brighter

    def rectangle(self, time_s: float, shape: Texture) -> Rectangle:
        """Return the patch just above the floor."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        u, v = np.array([c, s, 0.0]) * self.size_m[0], np.array([s, -c, 0.0]) * self.size_m[1]
        middle = np.array([*(at + time_s * v_mps for at, v_mps in zip(self.at, self.velocity_mps, strict=True)), 2e-3])
        return Rectangle(middle - (u + v) / 2, u, v, shape, "sun")


@dataclass(frozen=True, slots=True)
class World:
    """The floor is at z = 0 where the ground does not say otherwise; the robot starts at x, y [m], heading [rad]."""

    name: str
    standing: tuple[Rectangle, ...]
    people: tuple[Person, ...] = ()
    start: Pose = (0.0, 0.0, 0.0)
    brightness: float = 1.0  # factor on the grey of all images
    is_polished: bool = False  # the floor mirrors the objects on it
    ground: Ground = Ground()
    edges: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))  # [m] where the floor falls
    panes: tuple[Rectangle, ...] = ()  # of glass: seen by what they mirror, and touched
    sun: tuple[SunPatch, ...] = ()
    lights: tuple[tuple[float, float], ...] = ()  # time [s] from which on a factor on all greys holds

    def light_at(self, time_s: float) -> float:
        """Return the factor on the grey of all images."""
        factors = [factor for begin_s, factor in self.lights if begin_s <= time_s]
        return self.brightness * (factors[-1] if factors else 1.0)
