"""Refinement of corners to about a hundredth of a pixel, in a window that is aligned with the board.

Edges in a mirror image are curved and squares sheared, so a window that is straight in the image biases the corner.
The mapping from board to image comes from the neighbours, to second order, or exactly from a first calibration.
Without that second pass calibrated cameras are about 0.04 % too large.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import WINDOW, CalibrationBoard
from calib.boards.board_shape import local_mapping, quadratic_terms
from calib.boards.corner_candidates import Grey, sample
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import project_near

# Mapping of board offsets (..., 2) from a corner [squares] to pixels (..., 2).
ToImage = Callable[[Array], Array]

# Largest half side of the window in pixels, because farther grey levels do not depend on the corner's position.
REACH_PX = 8
# Least samples along a side of the window: 25 for the six terms of the surface, since 9 would be too few.
MIN_WINDOW_SAMPLES = 5
# Width of the window's Gaussian weight in parts of its half side.
WEIGHT_PART = 0.6
# Enough: 8 of 11 boards of test_board_finder.py end before; a last step is a fifth of the accuracy.
MAX_ITERATIONS = 4
CONVERGED_PX = 2e-3
# A corner that moves farther than this part of a square, plus some pixels, is reset, because it has reached another
# edge.
MAX_MOVE, MAX_MOVE_PX = 0.3, 0.3
# Step of the difference quotient by which the size of a square is measured [squares], a hundredth because a mapping
# bends within a square.
SIZE_STEP = 0.01


def refine_corners(image: NDArray[np.uint8], corners: Array) -> Array:
    """Move corners (rows, columns, 2) [px] onto the image's corners; those without enough neighbours stay."""
    grey, refined = image.astype(np.float32), corners.copy()
    for _ in range(MAX_ITERATIONS):
        moved = refined.copy()
        for j, i in np.argwhere(np.isfinite(corners[..., 0])):
            mapping = local_mapping(refined, int(j), int(i))
            if mapping is not None:
                moved[j, i] = refine_in_mapping(grey, mapping, corners[j, i])
        step = np.nanmax(np.linalg.norm(moved - refined, axis=2))
        refined = moved
        if step < CONVERGED_PX:
            break
    return refined


def refine_with_camera(
    image: NDArray[np.uint8], pixels: Array, board: CalibrationBoard, camera: OmniCamera, T_cam_board: Array
) -> Array:
    """Move the pixels (N, 2) of a board's corners onto those of the image, with a camera as the mapping."""
    grey, refined = image.astype(np.float32), pixels.copy()
    for index in np.flatnonzero(np.isfinite(pixels[:, 0])):
        to_image = _camera_mapping(camera, T_cam_board, board.points[index], board.square_m)
        moved = to_image(_converged_shift(grey, to_image, board.window)[None])[0]
        if np.linalg.norm(moved - pixels[index]) < MAX_MOVE * _square_px(to_image) + MAX_MOVE_PX:
            refined[index] = moved
    return refined


def _converged_shift(grey: Grey, to_image: ToImage, window: float) -> Array:
    """Return the corner's offset (2,) [squares] after the window (half side) was moved onto it iteratively."""
    shift = np.zeros(2)

    def shifted(xy: Array) -> Array:
        return to_image(xy + shift)

    for _ in range(MAX_ITERATIONS):
        shift = shift + _corner_offset(grey, shifted, window)
    return shift


def _camera_mapping(camera: OmniCamera, T_cam_board: Array, point: Array, square_m: float) -> ToImage:
    """Return the camera's mapping from the board, in squares about a point (3,) [m] of it, to the image."""

    def to_image(xy: Array) -> Array:
        offset = np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1) * square_m
        return project_near(camera, se3.apply(T_cam_board, (point + offset).reshape(-1, 3))).reshape(xy.shape)

    return to_image


def refine_in_mapping(grey: Grey, mapping: Array, start: Array, window: float = WINDOW) -> Array:
    """Return the corner's pixel (2,) in the window of a local mapping (6, 2); start (2,) if it moves too far.

    mapping: see local_mapping; window: half side [squares].
    """

    def to_image(xy: Array) -> Array:
        return np.asarray(quadratic_terms(xy[..., 0], xy[..., 1]) @ mapping)

    moved = to_image(_corner_offset(grey, to_image, window))
    limit_px = MAX_MOVE * _square_px(to_image) + MAX_MOVE_PX
    return moved if np.linalg.norm(moved - start) < limit_px else start


def _square_px(to_image: ToImage) -> float:
    """Return the side of a square at the corner [px]."""
    ends = to_image(np.array([[0.0, 0], [SIZE_STEP, 0], [0, SIZE_STEP]])) * (1 / SIZE_STEP)
    return float(np.sqrt(abs(np.linalg.det(ends[1:] - ends[0]))))


def _corner_offset(grey: Grey, to_image: ToImage, window: float) -> Array:
    """Return the offset (2,) [squares] of the corner in the window about the origin of a mapping."""
    size = _square_px(to_image)
    reach = min(window, REACH_PX / max(size, 1e-6))
    # An odd number of samples, about one a pixel.
    side = int(np.clip(np.ceil(2 * reach * size), MIN_WINDOW_SAMPLES, 2 * REACH_PX)) // 2 * 2 + 1
    x, y = np.meshgrid(*2 * [np.linspace(-reach, reach, side)])
    pixels = to_image(np.stack([x, y], axis=-1))
    return _saddle_point(sample(grey, pixels), x, y) if np.isfinite(pixels).all() else np.zeros(2)


def _saddle_point(window: Array, x: Array, y: Array) -> Array:
    """Return the stationary point (2,) of the second-order surface through a window at x, y; 0 if it is not a saddle.

    Lucchese and Mitra 2002. Halos and blooming move all four edges but not this point: on real images it fits cameras
    better than the intersection of the edges' gradients.
    """
    reach = float(x.max())
    weight = np.exp(-(x * x + y * y) / (2 * (WEIGHT_PART * reach) ** 2)).ravel()
    A = quadratic_terms(x.ravel(), y.ravel()) * weight[:, None]
    _, gx, gy, xx, xy, yy = np.linalg.lstsq(A, window.ravel() * weight, rcond=None)[0]
    determinant = 4 * xx * yy - xy * xy
    if determinant >= 0:
        return np.zeros(2)
    shift = np.array([xy * gy - 2 * yy * gx, xy * gx - 2 * xx * gy]) / determinant
    return np.asarray(np.clip(shift, -reach, reach))
