"""Image of the posterior in four rooms: `python -m tests.experiments.obstacle_posterior.image` writes docs/images.

Above: the log-odds of each cell that it is floor, rather than its best other explanation. Below: what follows from all
layers, free, taken or unknown. Black lines: what truly stands there, and edges; the base has driven to the circle.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from omnid.core.obstacles.cell_kernels import LIMIT
from omnid.core.obstacles.grid import CELL_M, CELLS, ObstacleGrid
from tests.experiments.obstacle_posterior.drives import (
    RADIUS_M,
    START_M,
    STEP_M,
    Scores,
    exposures,
    floor_odds,
    judge,
    usual_robot,
)
from tests.experiments.obstacle_posterior.scenes import ObstacleScene, obstacle_scene, render_pair

FILE: Final = Path(__file__).parents[3] / "docs" / "images" / "posterior.png"
CASES: Final = ("plain pole", "edge 8 cm", "white wall", "glossy")
SEED: Final = 1
SIZE_PX, STEPS = 512, 24  # to 5 cm before x = 0
AROUND_M: Final = (-1.5, 3.0)  # along x, and half of it to either side
STATES: Final = ListedColormap(["0.75", "#9fd39f", "#c0392b"])  # unknown, free, taken
DPI: Final = 100


def write(file: Path = FILE, cases: tuple[str, ...] = CASES, steps: int = STEPS, size_px: int = SIZE_PX) -> None:
    """Write the image of some cases."""
    figure, robot = Figure((3 * len(cases), 6.2), dpi=DPI, layout="constrained"), usual_robot(size_px)
    axes = figure.subplots(2, len(cases), squeeze=False)
    for column, case in enumerate(cases):
        scene = obstacle_scene(case, SEED)
        grid = judge(scene, robot, exposures(partial(render_pair, scene, robot), robot, steps, SEED), Scores())
        _draw(axes[0, column], grid, scene, START_M + STEP_M * (steps - 1))
        _draw(axes[1, column], grid, scene, START_M + STEP_M * (steps - 1), by_state=True)
        axes[0, column].set_title(case)
    odds = mpl.cm.ScalarMappable(mpl.colors.Normalize(-LIMIT, LIMIT), "RdYlGn")
    figure.colorbar(odds, ax=axes[0], label="log-odds of the floor", shrink=0.8)
    figure.savefig(file)


def _draw(axes: Axes, grid: ObstacleGrid, scene: ObstacleScene, x_m: float, *, by_state: bool = False) -> None:
    """Draw the cells around a base at x_m."""
    assert grid._corner is not None
    left_m, bottom_m = CELL_M * grid._corner
    extent = left_m, left_m + CELLS * CELL_M, bottom_m, bottom_m + CELLS * CELL_M
    if by_state:
        axes.imshow(grid.state(), STATES, origin="lower", extent=extent, vmin=0, vmax=2, interpolation="nearest")
    else:
        odds, most = floor_odds(grid._odds), float(LIMIT)
        axes.imshow(odds, "RdYlGn", origin="lower", extent=extent, vmin=-most, vmax=most, interpolation="nearest")
    axes.add_collection(LineCollection(list(scene.segments), colors="black", linewidths=1.5))
    axes.add_patch(mpl.patches.Circle((x_m, 0.0), RADIUS_M, fill=False, color="black"))
    half_m = (AROUND_M[1] - AROUND_M[0]) / 2
    axes.set(xlim=np.add(x_m, AROUND_M), ylim=(-half_m, half_m), aspect="equal", xticks=[], yticks=[])


if __name__ == "__main__":
    write()
