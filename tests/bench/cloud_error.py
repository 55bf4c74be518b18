"""Points of the cloud against the surfaces of the world: `python -m tests.bench.cloud_error LOG ... [--set ...]`.

LOG is a folder RECIPE_sSEED with log.mcap and truth.txt, rendered by `python -m tests.simulation RECIPE --seed SEED`.
The points are those of `omnid replay --cloud`. A cell of 10 cm is seen if a point within 10 cm of a surface lies in it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.api import replay
from omnid.formats.tum import read_tum
from omnid.simulation.rendering.surfaces import Scene
from tests.bench.accuracy import rig_of
from tests.bench.results import Cell, Column, ResultTable
from tests.bench.seeds import family_and_seed
from tests.simulation.recipes import build

Array = NDArray[np.float64]
CELL_M: Final = 0.1  # of the cells that count as seen, and largest distance of their points from a surface
FAR_M: Final = 0.2  # a point farther from all surfaces is wrong
COLUMNS: Final = (
    Column("log"),
    Column("points"),
    Column("error p50", "cm", 2),
    Column("error p90", "cm", 2),
    Column(f"beyond {FAR_M} m", "%", 2),
    Column("cells seen"),
)


def distances_m(points: Array, scene: Scene) -> Array:
    """Return the distances (N,) of points (N, 3) from the nearest rectangle of a scene."""
    nearest = np.full(len(points), np.inf)
    for face in scene.rectangles:
        edges = np.stack([face.edge_u, face.edge_v])
        shares = (points - face.origin) @ (edges / (edges**2).sum(axis=1, keepdims=True)).T
        nearest = np.minimum(nearest, np.linalg.norm(points - face.points(shares.clip(0, 1)), axis=1))
    return nearest


def measure(folder: Path, overrides: Sequence[str]) -> list[Cell]:
    """Return the row of a log."""
    world = family_and_seed(folder.name)
    if world is None:
        raise SystemExit(f"{folder}: expected a folder RECIPE_sSEED, whose world is known")
    truth = read_tum(folder / "truth.txt")
    result = replay(folder / "log.mcap", rig_of(folder), overrides=overrides)
    assert result.map is not None
    points = se3.apply(truth.T[0], result.map.xyz)
    error = distances_m(points, build(*world, pairs=len(truth.T)).scene)
    cells = np.unique(np.floor(points[error < CELL_M] / CELL_M), axis=0)
    p50, p90 = (100 * float(np.percentile(error, percent)) for percent in (50, 90))
    beyond = 100 * float((error > FAR_M).mean())
    return [folder.name, len(points), p50, p90, beyond, len(cells)]


def main() -> None:
    """Print the table of all logs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", dest="overrides")
    arguments = parser.parse_args()
    table = ResultTable("cloud_error", "Points of the cloud against the surfaces of the world", COLUMNS)
    for folder in arguments.logs:
        table.add(*measure(folder, arguments.overrides), folder=folder)


if __name__ == "__main__":
    main()
