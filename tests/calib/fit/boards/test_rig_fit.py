"""Calibration of a rig: exact and noisy corners, standard deviations, bent boards, ambiguous and inconsistent views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.board import Board, BoardView
from calib.boards.board_pose import ambiguous_orders
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.errors import CalibError
from calib.fit.boards.rig_fit import RigCalibration, fit_rig, rig_print_shape
from calib.fit.boards.rig_problem import PairView
from calib.models.camera import Array, Mask
from calib.models.unified import UnifiedCamera
from calib.rig import MountedCamera, Rig
from tests.simulation.boards import board_poses_around_rig

LOWER = UnifiedCamera(0.93, (-205.0, 206.2), (394.2, 380.9), (780, 768))


UPPER = UnifiedCamera(0.97, (-207.0, 206.2), (391.2, 382.9), (780, 768))


T_UPPER_LOWER = se3.transform(se3.rotation_exp([0.02, -0.015, 0.3]), [0.004, -0.006, 0.18])


RIG = Rig(
    MountedCamera(LOWER, np.eye(4), Mask(LOWER.center, 60.0, 372.0)),
    MountedCamera(UPPER, T_UPPER_LOWER, Mask(UPPER.center, 60.0, 372.0)),
)


ODD, EVEN, SQUARE = Board(7, 6, 0.03), Board(8, 6, 0.03), Board(6, 6, 0.03)


def pairs(board: Board, count: int = 10, noise_px: float = 0.0, seed: int = 0) -> list[PairView]:
    rng = np.random.default_rng(seed)
    made = []
    for k, T in enumerate(board_poses_around_rig(RIG, board, count, seed=seed)):
        both = [m.camera.project(se3.apply(m.T_cam_rig @ T, board.points)) for m in (RIG.lower, RIG.upper)]
        lower, upper = (BoardView(f"p{k}", pixels + noise_px * rng.standard_normal(pixels.shape)) for pixels in both)
        made.append(PairView(f"p{k}", (lower, upper)))
    return made


def with_upper_order(view: PairView, order: Array) -> PairView:
    lower, upper = view.seen
    assert upper
    return replace(view, seen=(lower, replace(upper, pixels=upper.pixels[order])))


def off(found: RigCalibration) -> tuple[float, float]:
    """Return the errors of the rotation [deg] and of the viewpoint [mm]."""
    gap = se3.inverse(T_UPPER_LOWER) @ found.T_upper_lower
    return float(np.rad2deg(np.linalg.norm(se3.rotation_log(gap[:3, :3])))), float(1e3 * np.linalg.norm(gap[:3, 3]))


@pytest.mark.parametrize("board", [ODD, EVEN, SQUARE])
def test_recovers_the_transform_for_every_orientation_of_the_boards(board: Board) -> None:
    orders = ambiguous_orders(board)
    assert len(orders) == {ODD: 1, EVEN: 2, SQUARE: 4}[board]
    views = [with_upper_order(view, orders[k % len(orders)]) for k, view in enumerate(pairs(board))]
    start = replace(LOWER, focal=(-209.0, 211.0), center=(395.5, 379.8))
    found = fit_rig(views, board, (start, UPPER))
    assert max(off(found)) < 1e-3 and found.pairs == 10 and found.rejected == ()
    assert found.lower.center == pytest.approx(LOWER.center, abs=1e-3)


def test_sigmas_are_consistent_with_errors() -> None:
    found = [fit_rig(pairs(ODD, noise_px=0.1, seed=seed), ODD, (LOWER, UPPER)) for seed in range(6)]
    length = float(np.linalg.norm(T_UPPER_LOWER[:3, 3]))
    baseline = np.array([(rig.baseline_m - length) / rig.baseline_sigma_m for rig in found])
    turn = np.array(
        [se3.log(rig.T_upper_lower @ se3.inverse(T_UPPER_LOWER))[3:] / rig.motion_sigma[3:] for rig in found]
    )
    assert 0.5 < np.sqrt(np.mean(baseline**2)) < 1.6 and 0.6 < np.sqrt(np.mean(turn**2)) < 1.4


def test_rejects_a_mismatched_pair_by_name() -> None:
    views = pairs(ODD, 10)
    lower, _ = views[3].seen
    views[3] = replace(views[3], seen=(lower, views[4].seen[1]))
    found = fit_rig(views, ODD, (LOWER, UPPER))
    assert [bad.name for bad in found.rejected] == ["p3"] and "was the board moving?" in found.rejected[0].reason
    assert max(off(found)) < 1e-3


def test_refuses_too_few_pairs() -> None:
    with pytest.raises(CalibError, match="expected at least 4 instants at which both cameras saw the board, found 3"):
        fit_rig(pairs(ODD)[:3], ODD, (LOWER, UPPER))
    exchanged = [
        replace(view, seen=(view.seen[0], pairs(ODD, 10, seed=9)[k].seen[1])) for k, view in enumerate(pairs(ODD)[:4])
    ]
    with pytest.raises(CalibError, match="expected at least 4 consistent pairs of views"):
        fit_rig(exchanged, ODD, (LOWER, UPPER))


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
