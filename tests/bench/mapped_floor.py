"""Cells of true things that the grid of a map calls free: `python -m tests.bench.mapped_floor --seeds FIRST LAST`.

A simulated robot is driven at random through rooms full of things (`room_of_things`) and maps them; the grid is that
of `omnid map export --grid`. A cell counts to a thing whose outline from above covers its middle; of what is narrower
than a cell, its middle line.
"""

from __future__ import annotations

import math
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from omnid.config import load_config
from omnid.core.mapping.scan_grid import FREE, OCCUPIED, Grid
from omnid.core.places.place_views import grid
from omnid.formats.place_file import read_places
from omnid.simulation.rendering.surfaces import Rectangle
from omnid.simulation.world import World
from tests.bench.fine_robot import fine_robot
from tests.bench.obstacles import RANDOMLY_S, Wanderer
from tests.bench.results import ResultTable, columns, run
from tests.simulation.disturbed import simulate
from tests.simulation.hazard_worlds import trial

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
CELL_M: Final = 0.05
SIZE_PX: Final = 512
HIGHEST_M: Final = 2.2  # Upper sides of things are lower than this, the ceiling is higher.
LOW_M, THIN_M, POLE_M, LONG_M = 0.1, 0.035, 0.12, 0.5  # limits of the kinds of things
FLOOR: Final = "floor without anything on it"
NEAR: Final = "floor within 0.2 m of things"
NEAR_CELLS: Final = 9  # side of the square of cells around a cell of a thing that is near it
REMARK: Final = "Drives at random of 40 s through cluttered rooms, 512 px at 10 Hz; true things seen from above."


def middles(grid: Grid, start: tuple[float, float, float]) -> Array:
    """Return the middles (H, W, 2) of cells in the world, in which the map's origin has the pose `start`."""
    rows, columns = np.indices(grid.cells.shape)
    x, y = (corner + (n + 0.5) * grid.cell_m for corner, n in zip(grid.corner, (columns, rows), strict=True))
    c, s = math.cos(start[2]), math.sin(start[2])
    return np.stack([start[0] + c * x - s * y, start[1] + s * x + c * y], axis=-1)


def covered(face: Rectangle, at: Array) -> Flags:
    """Return which of places (H, W, 2) lie in a level rectangle, which counts as at least a cell wide."""
    edges = np.stack([face.edge_u[:2], face.edge_v[:2]], axis=1)
    shares = (at - face.origin[:2]) @ np.linalg.inv(edges).T
    half = np.maximum(0.5, CELL_M / 2 / np.linalg.norm(edges, axis=0))
    return np.asarray((np.abs(shares - 0.5) <= half).all(axis=-1))


def kind_of(face: Rectangle) -> str:
    """Return the kind of a thing by its upper side."""
    narrow, wide = sorted((face.width_m, face.height_m))
    if face.origin[2] < LOW_M:
        return "boxes of 8 cm"
    if wide < POLE_M:
        return "poles and legs"
    if narrow < THIN_M and wide > LONG_M:
        return "bars"
    return "boxes and tables"


def things_of(world: World) -> list[Rectangle]:
    """Return the upper and lower sides of what stands on the floor."""
    return [
        face
        for face in world.standing
        if abs(face.edge_u[2]) + abs(face.edge_v[2]) < 1e-9 and 0.0 < face.origin[2] < HIGHEST_M
    ]


def count(world: World, grid: Grid, cells: dict[str, Array]) -> None:
    """Add the cells of a drive by kind: all, free, and occupied."""
    at, everything = middles(grid, world.start), np.zeros(grid.cells.shape, bool)
    parts: dict[str, Flags] = {}
    for face in things_of(world):
        inside = covered(face, at)
        parts[kind_of(face)] = parts.get(kind_of(face), np.zeros_like(everything)) | inside
        everything |= inside
    known = grid.cells == FREE
    around = cv2.dilate(everything.astype(np.uint8), np.ones((NEAR_CELLS, NEAR_CELLS), np.uint8)) > 0
    for kind, part in (*parts.items(), (FLOOR, known & ~everything), (NEAR, around & known & ~everything)):
        states = grid.cells == FREE, grid.cells == OCCUPIED
        cells[kind] += np.array([part.sum(), *((part & state).sum() for state in states)])


def mapped_floor(*, seeds: Sequence[int]) -> None:
    """Print a row for each kind of thing; seeds: the first and the last one."""
    head = columns("cells of", "cells", "free|%|2", "occupied|%|1")
    table = ResultTable("mapped_floor", "Cells of things that maps call free", head, (REMARK,))
    cells = defaultdict[str, Array](lambda: np.zeros(3))
    for seed in range(seeds[0], seeds[-1] + 1):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "room.omap"
            config, world = load_config(None, [f'places.map="{path}"']), trial("room_of_things", seed).world
            simulate(world, fine_robot(SIZE_PX), Wanderer(seed), seconds=RANDOMLY_S, seed=seed, config=config)
            count(world, grid(*read_places(path), CELL_M), cells)
        table.seeds.append(("mapped floor", seed))
    for kind, (total, *states) in sorted(cells.items()):
        table.add(kind, int(total), *(100 * part / max(total, 1) for part in states))


if __name__ == "__main__":
    run(mapped_floor)
