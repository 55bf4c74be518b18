"""Calibration of a rig: exact and noisy corners, standard deviations, ambiguous and inconsistent views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.boards.board import Board, BoardView
from calib.boards.board_pose import ambiguous_orders, board_pose
from calib.errors import CalibError
from calib.fit.boards.rig_fit import RigCalibration, fit_rig
from calib.fit.boards.rig_problem import PairView
from calib.models.ocam import OcamCamera
from tests.calib.fit.boards.rig_views import (
    EVEN,
    LOWER,
    ODD,
    RIG,
    SQUARE,
    T_UPPER_LOWER,
    UPPER,
    pairs,
    with_upper_order,
)
from tests.simulation.boards import board_poses_around_rig


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


def test_calibrates_polynomial_cameras() -> None:
    poly = OcamCamera((-131.6, 0.0, 1.9e-3, 9e-8, -6e-10), (380.9, 394.2), (0.998, 2e-4, 3e-4), (780, 768))
    T_POLY = se3.transform(np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    views = []
    for k, T in enumerate(board_poses_around_rig(RIG, ODD, 10)):
        seen = [
            BoardView(f"p{k}", poly.project(se3.apply(T_POLY @ m.T_cam_rig @ T, ODD.points)))
            for m in (RIG.lower, RIG.upper)
        ]
        if all(np.isfinite(one.pixels).all() for one in seen):
            views.append(PairView(f"p{k}", (seen[0], seen[1])))
    start = replace(poly, center_row_column=(382.0, 393.0))
    found = fit_rig(views, ODD, (start, poly))
    T = T_POLY @ T_UPPER_LOWER @ se3.inverse(T_POLY)
    np.testing.assert_allclose(found.T_upper_lower, T, atol=1e-4)
    assert found.lower.center == pytest.approx(poly.center, abs=0.01)


def test_views_of_one_camera_reduce_the_sigmas() -> None:
    views = pairs(ODD, 12, noise_px=0.2)
    alone = [replace(view, seen=(view.seen[0], None)) for view in views[6:]]
    few, more = (fit_rig(chosen, ODD, (LOWER, UPPER)) for chosen in (views[:6], views[:6] + alone))
    assert more.pairs == 6 and len(more.views) == 12
    sigmas = [{name: sigma for name, _, sigma in found.parameters[0]} for found in (few, more)]
    assert sigmas[1]["pu"] < 0.9 * sigmas[0]["pu"]


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


def test_estimates_the_board_pose_of_a_known_camera() -> None:
    T = board_poses_around_rig(RIG, ODD, 1)[0]
    pixels = LOWER.project(se3.apply(T, ODD.points))
    pixels[5] = np.nan
    found = board_pose(LOWER, pixels, ODD)
    assert found is not None
    np.testing.assert_allclose(found, T, atol=1e-9)
    assert board_pose(LOWER, np.full((42, 2), np.nan), ODD) is None
