"""A moving picture of a drive to a goal: `python -m tests.bench.film WORLD SEED FILE.gif`.

What the lower camera sees, as a panorama. Below it, from above in odom: floor that is free (white), unknown (grey) or
occupied (red) by the grid of that moment; the true outlines (black), the straight way to the goal (blue), and the base
with its way so far (green).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from PIL import Image

from calib.se2_arrays import composed, planar, relative
from omnid.config import load_config
from omnid.core.obstacles.grid import CELL_M, FREE, OCCUPIED, FloorGrid
from omnid.core.types.panorama import PaddedPanorama
from tests.bench.obstacles import Array, Asker, Planned, prepared, settings_for
from tests.simulation.disturbed import simulate
from tests.simulation.lockstep import Moment, Request

EVERY: Final = 10  # scans from one picture to the next
FRAME_MS: Final = 250
CELL_PX: Final = 3
AROUND_M: Final = 2.0  # about start and goal that is shown
COLOURS: Final = {FREE: (255, 255, 255), OCCUPIED: (90, 90, 220)}  # of cells, blue first
UNKNOWN_COLOUR, TRUTH, PLAN, BASE = (190, 190, 190), (0, 0, 0), (220, 90, 0), (0, 140, 0)
FACTOR: Final = 1 << 4  # OpenCV's points are in sixteenths of a pixel
GREY_STEP: Final = 16  # of panoramas, whose noise would fill the file


class Canvas:
    """Part of odom from above, y upwards."""

    def __init__(self, corner_m: Array, size_m: Array) -> None:
        self.corner_m, (self.width, self.height) = corner_m, np.ceil(size_m / CELL_M).astype(int) * CELL_PX
        self.image = np.full((self.height, self.width, 3), UNKNOWN_COLOUR, np.uint8)

    def cells(self, grid: FloorGrid) -> None:
        """Draw the cells of a grid."""
        rows, columns = (
            np.floor((np.arange(size) / CELL_PX * CELL_M + low_m - of_grid_m) / CELL_M).astype(int)
            for size, low_m, of_grid_m in zip(
                (self.height, self.width), self.corner_m[::-1], grid.corner_m[::-1], strict=True
            )
        )
        inside = [(at >= 0) & (at < len(grid.states)) for at in (rows, columns)]
        states = grid.states[np.ix_(rows[inside[0]], columns[inside[1]])]
        for state, colour in COLOURS.items():
            part = np.zeros((self.height, self.width), bool)
            part[np.ix_(*inside)] = states == state
            self.image[part[::-1]] = colour

    def pixels(self, points_m: Array) -> np.ndarray:
        """Return points (N, 2) in sixteenths of a pixel."""
        x, y = ((points_m - self.corner_m) / CELL_M * CELL_PX).T
        return np.rint(np.column_stack([x, self.height - y]) * FACTOR).astype(np.int32)

    def line(self, points_m: Array, colour: tuple[int, int, int], thickness: int = 1) -> None:
        """Draw a line through points (N, 2)."""
        cv2.polylines(self.image, [self.pixels(points_m)], False, colour, thickness, cv2.LINE_8, 4)


def film(planned: Planned) -> list[np.ndarray]:
    """Make the drive; return its pictures."""
    asked, robot = prepared(planned)
    config, asker, panoramas = (
        load_config(None, settings_for(planned)),
        Asker(asked, planned),
        dict[int, PaddedPanorama](),
    )

    def keep(moment: Moment) -> Iterable[Request]:
        if moment.odometry is not None:
            panoramas[moment.odometry.stamp_ns] = moment.odometry.depth.panoramas.lower
        return asker(moment)

    run = simulate(asked.world, robot, keep, seconds=90.0, seed=planned.seed, config=config)
    assert asked.goal is not None, "a film needs a world with a goal"
    # 1. The truth in odom, and what is shown of it.
    from_start = relative(np.array(asked.world.start), np.zeros(3))
    outlines = asked.world.footprints(asked.world.standing, robot.height_m)
    flat = np.column_stack([outlines.reshape(-1, 2), np.zeros(2 * len(outlines))])
    outlines = composed(np.repeat(from_start[None], len(flat), 0), flat)[:, :2].reshape(-1, 2, 2)
    ends = np.array([np.zeros(2), asked.goal[:2]])
    corner_m = ends.min(axis=0) - AROUND_M
    size_m = ends.max(axis=0) + AROUND_M - corner_m
    plans = [(update.stamp_ns, update.plan.xy) for update in run.navigation if update.plan is not None]
    # 2. A picture of some scans.
    pictures, way = [], np.array([planar(scan.T_odom_base) for scan in run.scans])
    for number in range(0, len(run.scans), EVERY):
        scan, canvas = run.scans[number], Canvas(corner_m, size_m)
        if scan.grid is None or scan.stamp_ns not in panoramas:
            continue
        canvas.cells(scan.grid)
        for outline in outlines:
            canvas.line(outline, TRUTH)
        plan = [xy for stamp_ns, xy in plans if stamp_ns <= scan.stamp_ns][-1:]
        for xy in plan:
            canvas.line(xy, PLAN, 2)
        canvas.line(way[: number + 1, :2], BASE, 2)
        x, y, heading = way[number]
        radius_px = round(robot.radius_m / CELL_M * CELL_PX * FACTOR)
        cv2.circle(canvas.image, canvas.pixels(np.array([[x, y]]))[0].tolist(), radius_px, BASE, 2, cv2.LINE_8, 4)
        nose = [x + robot.radius_m * np.cos(heading), y + robot.radius_m * np.sin(heading)]
        canvas.line(np.array([[x, y], nose]), BASE, 2)
        view = panoramas[scan.stamp_ns].panorama
        view = cv2.resize(view, (canvas.width, canvas.width * len(view) // view.shape[1]), interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(view // GREY_STEP * GREY_STEP, cv2.COLOR_GRAY2BGR)
        pictures.append(np.vstack([grey, canvas.image]))
    return pictures


def main() -> None:
    """Write the file."""
    world, seed, file = sys.argv[1:]
    first, *others = (Image.fromarray(picture[..., ::-1]) for picture in film(Planned(world, int(seed))))
    first.save(file, save_all=True, append_images=others, duration=FRAME_MS, loop=0)
    print(f"{1 + len(others)} pictures, {Path(file).stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
