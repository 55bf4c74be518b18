"""Boards that are bent or stretched: found by rigs and by one camera, and flat boards stay flat."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.boards.board import BoardView
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.fit.boards.rig_fit import RigCalibration, fit_rig, rig_print_shape
from calib.fit.boards.rig_problem import PairView
from tests.calib.fit.boards.test_rig_fit import LOWER, ODD, RIG, UPPER, off
from tests.simulation.boards import board_poses_around_rig

NOISE_PX = 0.01
BENT = PrintShape((0.8e-3, -0.5e-3, 0.3e-3, 0.0))
STRETCHED = PrintShape((0.0, 0.0, 0.0, 0.004))


def views_of(shape: PrintShape, seed: int = 0, count: int = 14) -> list[PairView]:
    rng = np.random.default_rng(seed)
    made = []
    for k, T in enumerate(board_poses_around_rig(RIG, ODD, count, seed=seed)):
        points = shape.points(ODD.points)
        lower, upper = (
            BoardView(f"p{k}", pixels + NOISE_PX * rng.standard_normal(pixels.shape))
            for pixels in (m.camera.project(se3.apply(m.T_cam_rig @ T, points)) for m in (RIG.lower, RIG.upper))
        )
        made.append(PairView(f"p{k}", (lower, upper)))
    return made


def fitted(shape: PrintShape) -> tuple[RigCalibration, RigCalibration]:
    """Return the rig fitted to a board as drawn, and to its shape."""
    flat = fit_rig(views_of(shape), ODD, (LOWER, UPPER))
    return flat, fit_rig(flat.views, ODD, (flat.lower, flat.upper), shape=rig_print_shape(flat))


@pytest.mark.parametrize("shape", [BENT, STRETCHED, PrintShape((3e-3, 0.0, 0.0, 0.003))])
def test_a_rig_finds_the_shape_and_fits_to_its_noise(shape: PrintShape) -> None:
    flat, found = fitted(shape)
    np.testing.assert_allclose(found.shape.values, shape.values, atol=3e-5)
    assert found.fit.mean_px < 1.3 * NOISE_PX < 0.5 * flat.fit.mean_px
    assert max(off(found)) < 0.2 * max(off(flat))


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 8), marks=pytest.mark.slow)])
def test_flat_boards_stay_flat_and_their_rigs_the_same(seeds: range) -> None:
    for seed in seeds:
        flat = fit_rig(views_of(AS_DRAWN, seed), ODD, (LOWER, UPPER))
        assert rig_print_shape(flat) == AS_DRAWN == flat.shape
