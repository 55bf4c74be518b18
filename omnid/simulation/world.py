"""A simulated world: walls and objects, people who walk along polylines, light, and the obstacles of a robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib import se3
from calib.models.camera import Array
from drivers.motors.simulated_motor import Pose
from omnid.simulation.rendering.surfaces import Rectangle

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Person:
    """A box of a person's size that walks along a path and faces ahead."""

    faces: tuple[Rectangle, ...]  # in a frame on the floor below the middle, x ahead
    path: tuple[Point, ...]  # m
    speed_mps: float
    repeat: str = "once"  # once | loop | back and forth
    start_s: float = 0.0
    starts_within_m: float = 0.0  # waits until the robot is this near to the last point of the path; 0: does not wait
    rests_s: tuple[float, ...] = ()  # at the points of a path that is walked once; none: does not rest

    def place(self, walked_s: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad] after a time of walking."""
        points = np.array(self.path)
        reached_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        along_m, back, total_m = self.speed_mps * max(walked_s, 0.0), False, float(reached_m[-1])
        if self.rests_s:
            rested_s = np.cumsum(self.rests_s)
            arrives_s = reached_m / self.speed_mps + rested_s - self.rests_s
            times_s = np.column_stack([arrives_s, arrives_s + self.rests_s]).ravel()
            along_m = float(np.interp(walked_s, times_s, np.repeat(reached_m, 2)))
        if self.repeat != "once" and total_m > 0.0:
            laps, along_m = divmod(along_m, total_m)
            back = self.repeat == "back and forth" and laps % 2 == 1
        along_m = min(along_m, total_m)
        along_m = total_m - along_m if back else along_m
        part = min(int(np.searchsorted(reached_m[1:], along_m)), len(points) - 2)
        ahead = (points[part + 1] - points[part]) * (-1 if back else 1)
        x_m, y_m = (float(np.interp(along_m, reached_m, points[:, axis])) for axis in (0, 1))
        return x_m, y_m, math.atan2(ahead[1], ahead[0])


class Walkers:
    """The people of a world as time passes; those who wait for the robot begin when it is near enough."""

    def __init__(self, people: tuple[Person, ...]) -> None:
        self._people = people
        self._started_s: list[float | None] = [None if person.starts_within_m else person.start_s for person in people]
        self.time_s = 0.0

    def advance(self, time_s: float, robot: Point) -> None:
        """Set the time, with the robot at a point [m]."""
        self.time_s = time_s
        for number, person in enumerate(self._people):
            is_near = math.dist(robot, person.path[-1]) <= person.starts_within_m
            if self._started_s[number] is None and time_s >= person.start_s and is_near:
                self._started_s[number] = time_s

    def faces(self) -> list[Rectangle]:
        """Return the people's rectangles in the world now."""
        return [
            moved(face, place)
            for person, place in zip(self._people, self.places(), strict=True)
            for face in person.faces
        ]

    def places(self) -> list[tuple[float, float, float]]:
        """Return x, y [m] and heading [rad] of each person now."""
        return [
            person.place(0.0 if started_s is None else self.time_s - started_s)
            for person, started_s in zip(self._people, self._started_s, strict=True)
        ]


def moved(face: Rectangle, place: tuple[float, float, float]) -> Rectangle:
    """Return a rectangle of a frame on the floor in the world; its texture is shared."""
    x_m, y_m, heading_rad = place
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    R: Array = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return replace(face, origin=R @ face.origin + (x_m, y_m, 0.0), edge_u=R @ face.edge_u, edge_v=R @ face.edge_v)


FLOOR_M = 0.02  # Objects that are lower than this are driven over.


@dataclass(frozen=True)
class World:
    """A level floor at z = 0 and what is on it; the robot starts at x, y [m], heading [rad].

    Subclasses override its methods for ground that is not level and light that changes.
    """

    name: str
    standing: tuple[Rectangle, ...]
    people: tuple[Person, ...] = ()
    start: Pose = (0.0, 0.0, 0.0)
    brightness: float = 1.0  # factor on the grey of all images

    def T_world_base(self, pose: Pose) -> Array:
        """Return the pose (4, 4) of a base there; x, y and heading are those of its middle."""
        x_m, y_m, heading_rad = pose
        return se3.transform(se3.rotation_exp([0.0, 0.0, heading_rad]), [x_m, y_m, 0.0])

    def turned_rad(self, before: Pose, now: Pose) -> Array:
        """Return the rotation vector (3,) of a base between two poses, in its own frame."""
        return np.array([0.0, 0.0, math.remainder(now[2] - before[2], math.tau)])

    def light_at(self, time_s: float) -> float:
        """Return the factor on the grey of all images."""
        return self.brightness

    def footprints(self, rectangles: Sequence[Rectangle], height_m: float) -> Array:
        """Return the segments (N, 2, 2) [m] on the floor of all that reaches below a height, other than the floor.

        Rectangles named "floor" are never met. Boxes and walls are closed by upright rectangles, so that their outlines
        are enough.
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

    def obstacles(self, height_m: float) -> Array:
        """Return the segments (N, 2, 2) [m] of all that a robot of a height may touch."""
        return self.footprints(self.standing, height_m)


def distances_m(segments: Array, places: Array) -> Array:
    """Return the distances (M,) [m] of places (M, 2) from the nearest of segments (N, 2, 2); inf without any."""
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    to_place = places[:, None] - a
    share = np.clip((to_place * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
    distances = np.linalg.norm(to_place - share[..., None] * along, axis=2)
    return np.asarray(distances.min(axis=1, initial=np.inf))


def cross_track_m(first: Array, second: Array) -> Array:
    """Return the distances (M,) [m] of positions (M, 2) from the line through others (N, 2)."""
    return distances_m(np.stack([first, np.vstack([first[1:], first[-1:]])], axis=1), second)


def clearance_m(segments: Array, place: tuple[float, float], radius_m: float) -> float:
    """Return the distance [m] from a disc, the robot's outline, to the nearest of segments; 0 or less: contact."""
    return float(distances_m(segments, np.array([place]))[0]) - radius_m
