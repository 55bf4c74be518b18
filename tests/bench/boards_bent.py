"""Rigs calibrated by boards that are bent and stretched: `python -m tests.bench.boards_bent [--seeds 36 601]`.

The rigs are those of `boards_truth`. Each is calibrated by the images of a flat board, of one that a hand bends and a
printer stretches, and of one that is bent by 3 mm. "As drawn" is a fit of the same corners and camera models to a flat
board, which is what a calibration was before it knew of bends.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.fit.boards.rig_fit import RigCalibration, fit_rig
from calib.rig import Rig
from omnid.calibration.images import SIDES
from omnid.calibration.rig import calibrate_rig
from omnid.simulation.rendering.sensor import Sensor
from tests.bench.boards_truth import BOARD, random_rig
from tests.bench.results import Column, ResultTable
from tests.simulation.boards import BoardRenderer, board_poses_around_rig

SHAPES = {
    "flat": AS_DRAWN,
    "by hand": PrintShape((0.8e-3, 0.3e-3, -0.2e-3, 0.002)),
    "3 mm": PrintShape((3e-3, 0.0, 0.0, 0.0)),
}
COLUMNS = (
    Column("rig"),
    Column("board"),
    Column("bent by", "mm", 3),
    Column("found", "mm", 3),
    Column("stretched by", "%", 3),
    Column("found", "%", 3),
    Column("baseline error", "%", 3),
    Column("as drawn", "%", 3),
    Column("reprojection error", "px", 3),
    Column("as drawn", "px", 3),
    Column("systematic", "px", 3),
    Column("as drawn", "px", 3),
)


def render_pairs(rig: Rig, shape: PrintShape, folder: Path, seed: int, pairs: int) -> None:
    """Write images of a board of that shape on all sides of a rig."""
    renderers = {
        side: BoardRenderer(BOARD, mounted, shape) for side, mounted in zip(SIDES, (rig.lower, rig.upper), strict=True)
    }
    for k, T in enumerate(board_poses_around_rig(rig, BOARD, pairs, seed=seed, distance_m=(0.2, 0.42))):
        for side, renderer in renderers.items():
            image = renderer.render_board(T, seed=1000 * seed + k, sensor=Sensor(noise_sigma=1.0)).image
            cv2.imwrite(str(folder / f"{side}_{k:02d}.png"), image)


def as_drawn(found: RigCalibration) -> RigCalibration:
    """Return the fit of the same corners to a board as drawn."""
    return fit_rig(found.views, found.board, (found.lower, found.upper))


def figures(found: RigCalibration, truth: Rig) -> tuple[float, float, float]:
    """Return the error of the baseline [%], the mean reprojection error and the larger systematic one [px]."""
    systematic_px = max(found.structure(side).systematic_px for side in range(len(SIDES)))
    return 100 * (found.baseline_m / truth.baseline_m - 1), found.fit.mean_px, systematic_px


def main(arguments: Sequence[str]) -> int:
    """Print a line for each rig and board; 1 if a flat board is found bent, or a bent one flat."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.boards_bent")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 36, 601])
    parser.add_argument("--size", type=int, default=480)
    parser.add_argument("--pairs", type=int, default=12)
    args, wrong = parser.parse_args(arguments), False
    table = ResultTable("boards_bent", "Boards as people print them", COLUMNS)
    for seed in args.seeds:
        truth = random_rig(seed, args.size)
        for name, shape in SHAPES.items():
            with tempfile.TemporaryDirectory() as folder:
                render_pairs(truth, shape, Path(folder), seed, args.pairs)
                found = calibrate_rig(Path(folder), BOARD, view="mirror").calibration
            flat = as_drawn(found)
            with_shape, without = figures(found, truth), figures(flat, truth)
            table.add(
                seed,
                name,
                1e3 * shape.sag_m(BOARD.points),
                1e3 * found.shape.sag_m(BOARD.points),
                100 * shape.stretch,
                100 * found.shape.stretch,
                *np.column_stack([with_shape, without]).ravel().tolist(),
                seed=("rigs of boards", seed),
            )
            wrong |= shape.is_as_drawn != found.shape.is_as_drawn
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
