"""A simulated world: what stands and walks in it, its light, and how far a robot is from what it may touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.models.camera import Array
from drivers.motors.simulated.simulated_base import Pose
from omnid.simulation.people import Person
from omnid.simulation.rendering.surfaces import Rectangle

FLOOR_M = 0.02  # what is lower than this is driven over


@dataclass(frozen=True)
class World:
    """A level floor at z = 0 and what is on it; the robot starts at x, y [m], heading [rad].

    What a subclass may change of a world are its methods: ground that is not level, light that changes.
    """

    name: str
    standing: tuple[Rectangle, ...]
    people: tuple[Person, ...] = ()
    start: Pose = (0.0, 0.0, 0.0)
    brightness: float = 1.0  # factor on the grey of all images

    def T_world_base(self, pose: Pose) -> Array:
        """Return the pose (4, 4) of a base that stands there; x, y and heading are those of its middle."""
        x_m, y_m, heading_rad = pose
        return se3.transform(se3.rotation_exp([0.0, 0.0, heading_rad]), [x_m, y_m, 0.0])

    def turned_rad(self, before: Pose, now: Pose) -> Array:
        """Return the rotation vector (3,) of a base between two poses, in its own frame."""
        return np.array([0.0, 0.0, math.remainder(now[2] - before[2], math.tau)])

    def light_at(self, time_s: float) -> float:
        """Return the factor on the grey of all images."""
        return self.brightness

    def footprints(self, rectangles: Sequence[Rectangle], height_m: float) -> Array:
        """Return the outlines (N, 2, 2) [m] of rectangles on the floor, see `footprints`."""
        return footprints(rectangles, height_m)

    def obstacles(self, height_m: float) -> Array:
        """Return the segments (N, 2, 2) [m] of all that a robot of a height may touch."""
        return self.footprints(self.standing, height_m)


def footprints(rectangles: Sequence[Rectangle], height_m: float) -> Array:
    """Return the segments (N, 2, 2) [m] on the floor of all that reaches below a height, other than the floor.

    Rectangles named "floor" are never met. Boxes and walls are closed by upright rectangles, so that their outlines are
    enough.
    """
    segments = []
    for rectangle in rectangles:
        corners = rectangle.corners
        low_m, high_m = corners[:, 2].min(), corners[:, 2].max()
        if rectangle.name != "floor" and high_m - low_m > FLOOR_M and low_m < height_m and high_m > FLOOR_M:
            spread = corners[:, :2] - corners[0, :2]
            far = int(np.argmax((spread**2).sum(axis=1)))
            other = int(np.argmax(((corners[:, :2] - corners[far, :2]) ** 2).sum(axis=1)))
            segments.append(corners[[far, other], :2])
    return np.array(segments).reshape(-1, 2, 2)


def distances_m(segments: Array, places: Array) -> Array:
    """Return the distances (M,) [m] of places (M, 2) from the nearest of segments (N, 2, 2); inf without any."""
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    to_place = places[:, None] - a
    share = np.clip((to_place * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    distances = np.linalg.norm(to_place - share[..., None] * along, axis=2)
    return np.asarray(distances.min(axis=1, initial=np.inf))


def clearance_m(segments: Array, place: tuple[float, float], radius_m: float) -> float:
    """Return the distance [m] from a disc, the robot's outline, to the nearest of segments; 0 or less: contact."""
    return float(distances_m(segments, np.array([place]))[0]) - radius_m
