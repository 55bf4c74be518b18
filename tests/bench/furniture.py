"""Furniture made of boxes that stands in the way of a robot; no number of the method was set on it."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World
from tests.bench.floating_boxes import Size, raised_box

Array = NDArray[np.float64]

PLAIN: Final = "plain "  # the same things in one grey
ASIDE_M: Final = 0.2  # Most that the middle of a thing is beside the robot's way.
AHEAD_M: Final = (2.2, 3.0)
GREYS: Final = (60, 230)


class Part(NamedTuple):
    """Box of a thing: the middle of its lower side from the middle of the thing, and its sides [m]."""

    at: Size
    size_m: Size


def _legs(apart: tuple[float, float], side_m: float, high_m: float) -> list[Part]:
    """Return four legs at the corners of a rectangle."""
    corners = [(x * apart[0] / 2, y * apart[1] / 2) for x in (1, -1) for y in (1, -1)]
    return [Part((x, y, 0.0), (side_m, side_m, high_m)) for x, y in corners]


def _chair(rng: random.Random) -> list[Part]:
    seat_m = rng.uniform(0.4, 0.48)
    back = [Part((-0.2, 0.0, z), (0.02, 0.42, 0.06)) for z in (0.6, 0.75, 0.88)]
    posts = [Part((-0.2, y, seat_m), (0.03, 0.03, 0.5)) for y in (0.2, -0.2)]
    return [*_legs((0.4, 0.4), 0.03, seat_m), Part((0.0, 0.0, seat_m), (0.42, 0.42, 0.03)), *posts, *back]


def _stool(rng: random.Random) -> list[Part]:
    high_m = rng.uniform(0.45, 0.75)
    return [*_legs((0.28, 0.28), 0.025, high_m), Part((0.0, 0.0, high_m), (0.33, 0.33, 0.03))]


def _ladder(rng: random.Random) -> list[Part]:
    wide_m = rng.uniform(0.4, 0.55)
    rungs = [Part((-0.3, 0.0, 0.28 * (n + 1)), (0.03, wide_m, 0.03)) for n in range(5)]
    return [*_legs((0.6, wide_m), 0.04, 1.6), *rungs]


def _barrier(rng: random.Random) -> list[Part]:
    """Return two posts and a belt between them, which is what is in the way."""
    posts = [Part((0.0, y, 0.0), (0.05, 0.05, 0.95)) for y in (0.75, -0.75)]
    return [*posts, Part((0.0, 0.0, rng.uniform(0.7, 0.9)), (0.005, 1.5, 0.05))]


def _pallet(rng: random.Random) -> list[Part]:
    runners = [Part((0.0, y, 0.0), (1.2, 0.1, 0.11)) for y in (-0.35, 0.0, 0.35)]
    boards = [Part((x, 0.0, 0.11), (0.12, 0.8, 0.02)) for x in (-0.54, -0.27, 0.0, 0.27, 0.54)]
    return runners + boards + ([Part((0.0, 0.0, 0.13), (0.9, 0.7, 0.4))] if rng.random() < 0.3 else [])


def _trolley(rng: random.Random) -> list[Part]:
    bed_m = rng.uniform(0.14, 0.24)
    handle = [Part((-0.45, y, bed_m), (0.03, 0.03, 0.7)) for y in (0.25, -0.25)]
    bar = Part((-0.45, 0.0, bed_m + 0.7), (0.03, 0.53, 0.03))
    return [*_legs((0.7, 0.5), 0.08, bed_m), Part((0.0, 0.0, bed_m), (0.9, 0.6, 0.05)), *handle, bar]


def _door(rng: random.Random) -> list[Part]:
    return [Part((0.0, 0.0, 0.005), (rng.uniform(0.7, 0.9), 0.04, 2.0))]


def _drawer(rng: random.Random) -> list[Part]:
    """Return a cabinet beside the way, and a drawer that stands out of it into the way."""
    return [Part((0.0, 0.95, 0.0), (0.5, 0.6, 1.2)), Part((0.0, 0.35, rng.uniform(0.3, 0.8)), (0.45, 0.6, 0.18))]


def _lying(rng: random.Random) -> list[Part]:
    return [Part((0.0, 0.0, 0.0), (0.4, 1.1, rng.uniform(0.18, 0.24))), Part((0.0, 0.7, 0.0), (0.2, 0.2, 0.2))]


def _steps(_: random.Random) -> list[Part]:
    return [Part((0.3 * n, 0.0, 0.15 * n), (0.3, 1.2, 0.15)) for n in range(4)]


def _block(rng: random.Random) -> list[Part]:
    return [Part((0.0, 0.0, 0.0), (rng.uniform(0.25, 0.5), rng.uniform(0.25, 0.5), rng.uniform(0.15, 0.6)))]


def _shelf(rng: random.Random) -> list[Part]:
    boards = [Part((0.0, 0.0, z), (0.35, 0.9, 0.02)) for z in (rng.uniform(0.3, 0.4), 0.8, 1.25, 1.7)]
    return [*_legs((0.32, 0.87), 0.025, 1.75), *boards]


# By name: its boxes, and the largest angle by which it is turned [deg].
THINGS: Final[dict[str, tuple[Callable[[random.Random], list[Part]], float]]] = {
    "chair": (_chair, 180.0),
    "stool": (_stool, 45.0),
    "ladder": (_ladder, 180.0),
    "barrier": (_barrier, 20.0),
    "pallet": (_pallet, 90.0),
    "trolley": (_trolley, 180.0),
    "open door": (_door, 25.0),
    "drawer": (_drawer, 10.0),
    "lying person": (_lying, 90.0),
    "steps up": (_steps, 15.0),
    "block": (_block, 90.0),
    "shelf": (_shelf, 90.0),
}
FURNITURE: Final = (*THINGS, *(PLAIN + name for name in THINGS))


def with_furniture(world: World, kind: str, rng: random.Random) -> World:
    """Return the world with a thing of FURNITURE near the x axis, 2.2 to 3 m ahead of the origin."""
    parts_of, turned_deg = THINGS[kind.removeprefix(PLAIN)]
    texture_rng = np.random.default_rng(rng.randrange(2**32))
    faces = [face for part in parts_of(rng) for face in raised_box(texture_rng, part.at, part.size_m)]
    if kind.startswith(PLAIN):
        grey = np.uint8(rng.uniform(*GREYS))
        faces = [replace(face, texture=np.full_like(face.texture, grey)) for face in faces]
    at = np.array([rng.uniform(*AHEAD_M), rng.uniform(-ASIDE_M, ASIDE_M), 0.0])
    nearest_m = min(float(face.corners[:, 0].min()) for face in faces)
    turn = _turned(math.radians(rng.uniform(-turned_deg, turned_deg)))
    placed = [_moved(face, turn, at - (min(nearest_m, 0.0), 0.0, 0.0)) for face in faces]
    return replace(world, standing=(*world.standing, *placed))


def _turned(yaw_rad: float) -> Array:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _moved(face: Rectangle, turn: Array, by: Array) -> Rectangle:
    """Return a face that is turned about the origin, and moved."""
    return replace(face, origin=turn @ face.origin + by, edge_u=turn @ face.edge_u, edge_v=turn @ face.edge_v)
