"""Cells of true things that the grid of a map calls free: `python -m tests.bench.mapped_floor --seeds FIRST LAST`.

A simulated robot is driven at random through rooms full of things (`room_of_things`) and maps them; the grid is that
of `omnid map export --grid`. A cell counts to a thing whose outline from above covers its middle; of what is narrower
than a cell, its middle line.

With --poles the robot drives between rows of plain poles and back (`pole_rows.py`), and a pole's kind is its width and
how near the base passes it.
"""

from __future__ import annotations

import argparse
import math
import random
import tempfile
from collections import defaultdict
from collections.abc import Callable
from functools import partial
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
from omnid.simulation.world_file import load_world
from tests.bench.fine_robot import fine_robot
from tests.bench.obstacles import RANDOMLY_S, Wanderer
from tests.bench.pole_rows import ThereAndBack, room_text
from tests.bench.results import Column, ResultTable
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
WIDE_POLE_M, NEAR_POLE_M = 0.06, 0.8  # limits of the kinds of plain poles: width, and from the base's outline
POLES_S: Final = 42.0
OF_ROOMS: Final = "Drives at random of 40 s through cluttered rooms, 512 px at 10 Hz; true things seen from above."
OF_POLES: Final = "Drives there and back between plain poles 3 to 10 cm wide, 512 px at 10 Hz."
KindOf = Callable[[Rectangle], str]


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


def pole_kind(radius_m: float, face: Rectangle) -> str:
    """Return the kind of a plain pole beside the x axis by its upper side; radius_m: of the base."""
    wide_m, middle = max(face.width_m, face.height_m), face.corners.mean(axis=0)
    width = "less" if wide_m < WIDE_POLE_M else "more"
    passed = "less" if abs(middle[1]) - wide_m / 2 - radius_m < NEAR_POLE_M else "more"
    return f"plain poles of {width} than 6 cm, passed at {passed} than 0.8 m"


def count(world: World, grid: Grid, cells: dict[str, Array], kind_of: KindOf) -> None:
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


def measure(seed: int, cells: dict[str, Array], *, poles: bool) -> None:
    """Drive a seed, and count the cells of its map."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.omap"
        world, of = drive(seed, path, poles=poles)
        found = grid(*read_places(path), CELL_M)
    count(world, found, cells, of)


def drive(seed: int, path: Path, *, poles: bool) -> tuple[World, KindOf]:
    """Drive a seed, and write its map; return the world, and the kinds of the things in it."""
    config, robot = load_config(None, [f'places.map="{path}"']), fine_robot(SIZE_PX)
    if not poles:
        world = trial("room_of_things", seed).world
        simulate(world, robot, Wanderer(seed), seconds=RANDOMLY_S, seed=seed, config=config)
        return world, kind_of
    file = path.with_suffix(".toml")
    file.write_text(room_text(random.Random(seed), robot.radius_m))
    world = load_world(str(file), seed)
    simulate(world, robot, ThereAndBack(), seconds=POLES_S, seed=seed, config=config)
    return world, partial(pole_kind, robot.radius_m)


def main() -> None:
    """Print a row for each kind of thing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, required=True, metavar=("FIRST", "LAST"))
    parser.add_argument("--poles", action="store_true", help="rows of plain poles instead of cluttered rooms")
    arguments = parser.parse_args()
    table = ResultTable(
        "mapped_poles" if arguments.poles else "mapped_floor",
        f"Cells of {'plain poles' if arguments.poles else 'things'} that maps call free",
        (
            Column("cells of"),
            Column("cells"),
            Column("free", "%", 2),
            Column("occupied", "%", 1),
        ),
        (OF_POLES if arguments.poles else OF_ROOMS,),
    )
    family, cells = table.name.replace("_", " "), defaultdict[str, Array](lambda: np.zeros(3))
    for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
        measure(seed, cells, poles=arguments.poles)
        table.seeds.append((family, seed))
    for kind, (total, *states) in sorted(cells.items()):
        table.add(kind, int(total), *(100 * part / max(total, 1) for part in states))


if __name__ == "__main__":
    main()
