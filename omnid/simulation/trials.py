"""What a robot is asked to do in a world like a building, and the spaces of such worlds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import cv2
import numpy as np

from calib.models.camera import Array
from drivers.motors.simulated.simulated_base import Pose
from omnid.simulation.building_parts import Builder, Part, plain_paint
from omnid.simulation.rendering.ray_caster import AS_NEEDED
from omnid.simulation.rendering.sensor import Sensor
from omnid.simulation.rendering.shapes import Point
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.robot import SimulatedRobot, make_robot
from omnid.simulation.world import World

WAY_M: Final = 8.0  # that is asked for straight on
BEHIND_M: Final = 2.0  # of the start, where a corridor begins
SLOWEST_MPS: Final = 0.1  # A drive that is slower than this on average ends unfinished.
FREE_M: Final = 0.36  # from the middle of a base to what stands beside a way that it can surely drive
CELL_M: Final = 0.05


SENSOR: Final = Sensor(vignette=0.25, flicker=0.005, is_compressed=True)


@dataclass(frozen=True, slots=True)
class Trial:
    """A world, the robot in it, and what is asked: a way straight on, or a goal.

    At a hazard, `things` and the edges of the floor are what must not be touched, and may end the way.
    """

    world: World
    changes: tuple[tuple[str, object], ...] = ()  # of fields of the robot
    way_m: float = WAY_M
    goal: Pose | None = None  # x, y [m], heading [rad] in odom, which begins at the start
    things: tuple[Rectangle, ...] | None = None  # None: nothing is in the way
    motion: Literal["ahead", "back", "turn left", "at random"] = "ahead"  # that is asked for

    def robot(self, size_px: int = 512) -> SimulatedRobot:
        """Return the robot, with images of a size that come as JPEG from a lens with vignetting."""
        usual = replace(make_robot(size_px), sensor=SENSOR, samples=AS_NEEDED)
        return replace(usual, **dict(self.changes))  # type: ignore[arg-type]


def corridor(b: Builder, *, width_m: float = 1.8, length_m: float = 14.0, floor: bool = True) -> tuple[Point, Point]:
    """Add a corridor along x about the robot's way; return its corners."""
    aside_m = b.rng.uniform(-0.1, 0.1)
    low, high = (-BEHIND_M, aside_m - width_m / 2), (length_m - BEHIND_M, aside_m + width_m / 2)
    if floor:
        b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=int(b.rng.integers(2, 5)), pictures=int(b.rng.integers(1, 4)))
    return low, high


def hall(b: Builder) -> tuple[Point, Point]:
    """Add a hall with windows on one side, and furniture along its walls; return its corners."""
    low, high = (-2.5, -3.5), (11.5, 3.5)
    b.ceiling_m = 3.2
    b.floor(low, high)
    b.ceiling(low, high, 3.0)
    b.room(low, high, doors=2, windows=4, pictures=3)
    for x_m in np.arange(0.5, 10.0, 3.0):
        b.shelf((x_m + b.rng.uniform(-0.5, 0.5), low[1] + 0.22), math.pi / 2)
    for x_m in (2.0, 7.0):
        place = x_m + b.rng.uniform(-1.0, 1.0), high[1] - 1.0
        b.table(place, (1.4, 0.7, 0.74))
        b.star_chair((place[0], place[1] - 0.7), b.rng.uniform(0, math.tau))
    return low, high


def built(b: Builder, **fields: object) -> World:
    """Return the world of what was built."""
    polished = {"is_polished": b.floor_kind == "slabs"}
    return World("", tuple(b.faces), panes=tuple(b.panes), **(polished | fields))  # type: ignore[arg-type]


def trolley(b: Builder) -> list[Part]:
    """Return a trolley whose handle is behind, with a load or without."""
    bed_m = b.rng.uniform(0.14, 0.24)
    legs: list[Part] = [((x, y, 0.0), (0.08, 0.08, bed_m)) for x in (0.35, -0.35) for y in (0.25, -0.25)]
    handle: list[Part] = [((-0.45, y, bed_m), (0.03, 0.03, 0.7)) for y in (0.25, -0.25)]
    bed: list[Part] = [((0.0, 0.0, bed_m), (0.9, 0.6, 0.05)), ((-0.45, 0.0, bed_m + 0.7), (0.03, 0.53, 0.03))]
    load: list[Part] = [((0.08, 0.0, bed_m + 0.05), (0.6, 0.5, b.rng.uniform(0.2, 0.5)))]
    return legs + handle + bed + load * int(b.rng.integers(2))


def put_thing(b: Builder, kind: str, at: Point) -> None:
    """Add a thing of a room."""
    rng, yaw_rad = b.rng, b.rng.uniform(0, math.tau)
    if kind == "chair":
        b.star_chair(at, yaw_rad)
    elif kind == "table":
        b.table(at, (0.8, 0.6, 0.72), yaw_rad)
    else:
        spans = {"box": (0.3, 0.6), "carton": (0.3, 0.5), "bin": (0.25, 0.3)}[kind]
        size_m = rng.uniform(*spans), rng.uniform(*spans), rng.uniform(0.3, 0.9)
        grey, grain = rng.uniform(40, 220), 6.0 if kind == "carton" else 1.0
        b.thing([((0.0, 0.0, 0.0), size_m)], at, yaw_rad, plain_paint(rng, grey, grain))


def can_drive(segments: Array, start: Point, goal: Point, beside_m: float = FREE_M) -> bool:
    """Return whether a way leads from start to goal that is nowhere nearer than beside_m to segments (N, 2, 2)."""
    points = np.concatenate([segments.reshape(-1, 2), [start, goal]])
    low = points.min(axis=0) - 1.0
    width, height = np.ceil((points.max(axis=0) + 1.0 - low) / CELL_M).astype(int).tolist()
    free = np.full((height, width), 255, np.uint8)
    for ends in np.rint((segments - low) / CELL_M).astype(int):
        cv2.line(free, ends[0].tolist(), ends[1].tolist(), 0)
    wide = cv2.distanceTransform(free, cv2.DIST_L2, 5) * CELL_M > beside_m
    _, parts = cv2.connectedComponents(wide.astype(np.uint8), connectivity=4)
    at = [parts[tuple(np.rint((np.array(place) - low) / CELL_M).astype(int)[::-1])] for place in (start, goal)]
    return bool(at[0] and at[0] == at[1])
