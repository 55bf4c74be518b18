"""Pose of a board in front of a known camera, and the corner orders that one image cannot distinguish."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import Board
from calib.models.camera import Array, OmniCamera

MIN_CORNERS = 6


def board_pose(camera: OmniCamera, pixels: Array, board: Board) -> Array | None:
    """Estimate T_cam_board (4, 4) from corners (N, 2), NaN for unknown ones; None if too few have a ray.

    Linear solution by the rays' homography [r1 r2 t] (Zhang 2000, section 2.1, with rays in place of pixels).
    """
    rays, xy1 = camera.lift(pixels), np.column_stack([board.points[:, :2] / board.square_m, np.ones(len(pixels))])
    known = np.isfinite(rays).all(axis=1)
    if known.sum() < MIN_CORNERS:
        return None
    rays, xy1 = rays[known], xy1[known]
    A = np.einsum("nij,nk->nijk", se3.hat(rays), xy1).reshape(-1, 9)
    H = np.linalg.svd(A, full_matrices=False)[2][-1].reshape(3, 3) / (board.square_m, board.square_m, 1)
    H /= np.linalg.norm(H[:, :2], axis=0).mean() * np.sign(np.sum(rays * (xy1 * (board.square_m, board.square_m, 1)
                                                                           @ H.T)))
    left, _, right = np.linalg.svd(H[:, :2], full_matrices=False)
    first = left @ right
    return se3.transform(np.column_stack([first, np.cross(first[:, 0], first[:, 1])]), H[:, 2])


def pose_error_rad(camera: OmniCamera, T_cam_board: Array, pixels: Array, board: Board) -> float:
    """Return the mean angle between the rays of corners (N, 2) and the board's points."""
    rays, points = camera.lift(pixels), se3.apply(T_cam_board, board.points)
    across = np.linalg.norm(np.cross(rays, points), axis=1)
    return float(np.nanmean(np.arctan2(across, (rays * points).sum(axis=1))))


def ambiguous_orders(board: Board) -> list[NDArray[np.intp]]:
    """Return the orders (N,) of the corners that one image of a board cannot distinguish; the first is the identity.

    If one side is odd and one even, the colours determine the order. Otherwise a rotation by 180 degrees is ambiguous,
    and for a square board with even sides every rotation by 90 degrees.
    """
    grid = np.arange(board.columns * board.rows).reshape(board.rows, board.columns)
    if (board.columns + board.rows) % 2:
        return [grid.ravel()]
    quarters = range(4) if board.columns == board.rows and board.columns % 2 == 0 else (0, 2)
    return [np.rot90(grid, quarter).ravel() for quarter in quarters]
