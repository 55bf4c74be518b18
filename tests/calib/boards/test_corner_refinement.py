"""Refinement of corners to hundredths of a pixel, in a window along the board."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.boards.corner_refinement import MAX_MOVE, MAX_MOVE_PX, refine_corners, refine_with_camera
from calib.models.unified import UnifiedCamera
from tests.calib.boards.sheets import BOARD, sheet
from tests.simulation.boards import SQUARE_PX


def test_corners_move_onto_those_of_the_image() -> None:
    seen = sheet(noise=1.0)
    moved = refine_corners(seen.image, seen.corners + np.random.default_rng(2).normal(0, 0.8, seen.corners.shape))
    apart = np.linalg.norm(moved - seen.corners, axis=2)
    assert np.median(apart) < 0.05 and apart.max() < 0.15


def test_hidden_corners_stay_unknown_and_none_goes_to_another_edge() -> None:
    seen = sheet()
    start = seen.corners.copy()
    start[1, 1] = np.nan
    assert np.isnan(refine_corners(seen.image, start)[1, 1]).all()
    elsewhere = seen.corners + np.array([0.45 * SQUARE_PX, 0.3 * SQUARE_PX])
    moved = np.linalg.norm(refine_corners(seen.image, elsewhere) - elsewhere, axis=2)
    assert 0 < moved.max() < MAX_MOVE * SQUARE_PX + MAX_MOVE_PX + 0.1


def test_a_camera_is_the_mapping_of_a_second_pass() -> None:
    """A pinhole camera sees the sheet at a distance of 0.6 m; a square has 24 px."""
    seen, focal_px = sheet(noise=1.0), SQUARE_PX / BOARD.square_m * 0.6
    u, v = seen.corners[0, 0].tolist()
    camera = UnifiedCamera(0.0, (focal_px, focal_px), (u, v), (340, 300))
    T_cam_board = se3.transform(se3.rotation_exp([0, 0, -np.deg2rad(20.0)]), [0, 0, 0.6])
    start = seen.pixels + np.random.default_rng(2).normal(0, 0.5, seen.pixels.shape)
    moved = refine_with_camera(seen.image, start, BOARD, camera, T_cam_board)
    assert np.median(np.linalg.norm(moved - seen.pixels, axis=1)) < 0.05
