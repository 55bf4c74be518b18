"""Boxes that do not stand on the floor: bars, tables and the tines of a fork lift, for worlds of the benchmarks."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Final

import numpy as np

from omnid.simulation.rendering.shapes import box
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World

Size = tuple[float, float, float]  # along x, y, z [m]

BAR_M: Final = 0.03
END_ON_M: Final[Size] = (1.4, 0.04, 0.04)  # a bar that points at the robot
TINE_M: Final[Size] = (1.0, 0.12, 0.06)
TABLE_M: Final[Size] = (0.8, 0.6, 0.04)
LEG_M: Final = 0.04
KINDS: Final = ("bar", "bar end-on", "table", "tines")


def with_floating(world: World, kind: str, rng: random.Random) -> World:
    """Return the world with a thing of KINDS on the x axis, 2 to 3 m ahead of the origin."""
    texture_rng, at_m = np.random.default_rng(rng.randrange(2**32)), rng.uniform(2.0, 3.0)
    if kind == "bar":
        parts = raised_box(texture_rng, (at_m, 0.0, rng.uniform(0.12, 1.1)), (BAR_M, 1.4, BAR_M))
    elif kind == "bar end-on":
        at = (at_m + END_ON_M[0] / 2, rng.uniform(-0.15, 0.15), rng.uniform(0.12, 1.1))
        parts = raised_box(texture_rng, at, END_ON_M)
    elif kind == "table":
        top_m, (length, width, _) = rng.uniform(0.6, 0.8), TABLE_M
        parts = raised_box(texture_rng, (at_m, 0.0, top_m), TABLE_M)
        for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            at = (at_m + x * (length - LEG_M) / 2, y * (width - LEG_M) / 2, 0.0)
            parts += raised_box(texture_rng, at, (LEG_M, LEG_M, top_m))
    else:
        aside_m, low_m = rng.uniform(-0.1, 0.1), rng.uniform(0.04, 0.1)
        parts = raised_box(texture_rng, (at_m + TINE_M[0], aside_m, 0.0), (0.6, 0.9, 1.1))
        for side in (1, -1):
            parts += raised_box(texture_rng, (at_m + TINE_M[0] / 2, aside_m + side * 0.25, low_m), TINE_M)
    return replace(world, standing=(*world.standing, *parts))


def raised_box(texture_rng: np.random.Generator, at: Size, size_m: Size) -> list[Rectangle]:
    """Return a box with its lower side at the height of `at`, the middle of that side."""
    lift = np.array([0.0, 0.0, at[2]])
    faces = [replace(face, origin=face.origin + lift) for face in box(texture_rng, (at[0], at[1]), size_m, 0.0)]
    top = faces[-1]
    return [*faces, replace(top, origin=top.origin - (0.0, 0.0, size_m[2]))]
