"""Refinement of corners to about a hundredth of a pixel, in a window that is aligned with the board.

Edges in a mirror image are curved and squares sheared, so a window that is straight in the image biases the corner.
The mapping from board to image comes from the neighbours, to second order, or exactly from a first calibration.
Without that second pass calibrated cameras are about 0.04 % too large.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import WINDOW, CalibrationBoard
from calib.boards.board_shape import local_mapping, quadratic_terms
from calib.boards.corner_candidates import Grey, sample
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import project_near

# Mappings of the board to the image about corners: of the numbers (M,) of corners, and offsets (M, K, 2) [squares] from
# each of these, to pixels (M, K, 2).
ToImage = Callable[[NDArray[np.intp], Array], Array]

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
        mappings = {
            (int(j), int(i)): mapping
            for j, i in np.argwhere(np.isfinite(corners[..., 0]))
            if (mapping := local_mapping(refined, int(j), int(i))) is not None
        }
        if not mappings:
            break
        moved, places = refined.copy(), tuple(np.array(list(mappings)).T)
        moved[places] = refine_in_mappings(grey, np.array(list(mappings.values())), corners[places])
        step = np.nanmax(np.linalg.norm(moved - refined, axis=2))
        refined = moved
        if step < CONVERGED_PX:
            break
    return refined


def refine_with_camera(
    image: NDArray[np.uint8], pixels: Array, board: CalibrationBoard, camera: OmniCamera, T_cam_board: Array
) -> Array:
    """Move the pixels (N, 2) of a board's corners onto those of the image, with a camera as the mapping."""
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    points = board.points[seen]

    def to_image(which: NDArray[np.intp], xy: Array) -> Array:
        at = points[which, None] + board.square_m * np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=2)
        return project_near(camera, se3.apply(T_cam_board, at.reshape(-1, 3))).reshape(xy.shape)

    grey, shift = image.astype(np.float32), np.zeros((len(seen), 2))
    for _ in range(MAX_ITERATIONS):
        step = _corner_offsets(grey, to_image, shift, board.window)
        shift = shift + step
        if not (np.abs(step) * _squares_px(to_image, shift)[:, None] > CONVERGED_PX).any():
            break
    refined = pixels.copy()
    refined[seen] = _unless_far(to_image, shift, pixels[seen])
    return refined


def refine_in_mappings(grey: Grey, mappings: Array, start: Array, window: float = WINDOW) -> Array:
    """Return the corners' pixels (M, 2) in the windows of local mappings (M, 6, 2).

    start (M, 2): the pixels of corners that move too far from there.
    mappings: see local_mapping; window: half side [squares].
    """

    def to_image(which: NDArray[np.intp], xy: Array) -> Array:
        return np.asarray(quadratic_terms(xy[..., 0], xy[..., 1]) @ mappings[which])

    return _unless_far(to_image, _corner_offsets(grey, to_image, np.zeros((len(mappings), 2)), window), start)


def _unless_far(to_image: ToImage, shift: Array, start: Array) -> Array:
    """Return the pixels (M, 2) of shifted corners; start (M, 2) of those that have reached another edge."""
    every = np.arange(len(shift))
    moved = to_image(every, shift[:, None])[:, 0]
    limit_px = MAX_MOVE * _squares_px(to_image, np.zeros_like(shift)) + MAX_MOVE_PX
    return np.where((np.linalg.norm(moved - start, axis=1) < limit_px)[:, None], moved, start)


def _squares_px(to_image: ToImage, shift: Array) -> Array:
    """Return the sides (M,) of the squares at corners that are shifted (M, 2) [squares], in pixels."""
    ends = to_image(np.arange(len(shift)), shift[:, None] + SIZE_STEP * np.array([[0.0, 0], [1, 0], [0, 1]]))
    return np.asarray(np.sqrt(np.abs(np.linalg.det((ends[:, 1:] - ends[:, :1]) / SIZE_STEP))))


def _corner_offsets(grey: Grey, to_image: ToImage, shift: Array, window: float) -> Array:
    """Return the offsets (M, 2) [squares] of the corners in windows about places that are shifted (M, 2)."""
    size = _squares_px(to_image, shift)
    reach = np.minimum(window, REACH_PX / np.maximum(size, 1e-6))
    # An odd number of samples along a side, about one a pixel.
    samples = np.ceil(2 * reach * np.nan_to_num(size))
    side = np.clip(samples, MIN_WINDOW_SAMPLES, 2 * REACH_PX).astype(int) // 2 * 2 + 1
    offsets = np.zeros_like(shift)
    for count in np.unique(side):
        which = np.flatnonzero(side == count)
        grid, weight, inverse = _window_fit(int(count))
        pixels = to_image(which, shift[which, None] + reach[which, None, None] * grid)
        known = np.isfinite(pixels).all(axis=(1, 2))
        terms = (sample(grey, pixels[known]) * weight) @ inverse.T
        offsets[which[known]] = _saddle_points(terms) * reach[which[known], None]
    return offsets


@cache
def _window_fit(side: int) -> tuple[Array, Array, Array]:
    """Return the samples (K, 2) of a window in parts of its half side, their weights (K,), and the matrix (6, K) that
    maps weighted grey levels to the terms of the surface of second order.
    """
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, side)]), axis=-1).reshape(-1, 2)
    weight = np.exp(-(grid**2).sum(axis=1) / (2 * WEIGHT_PART**2))
    return grid, weight, np.linalg.pinv(quadratic_terms(*grid.T) * weight[:, None])


def _saddle_points(terms: Array) -> Array:
    """Return the stationary points (M, 2) of surfaces of second order (M, 6), within the window; 0 if it is no saddle.

    Lucchese and Mitra 2002. Halos and blooming move all four edges but not this point: on real images it fits cameras
    better than the intersection of the edges' gradients.
    """
    _, gx, gy, xx, xy, yy = terms.T
    determinant = 4 * xx * yy - xy * xy
    is_saddle = determinant < 0
    safe = np.where(is_saddle, determinant, -1.0)
    points = np.stack([xy * gy - 2 * yy * gx, xy * gx - 2 * xx * gy], axis=1) / safe[:, None]
    return np.where(is_saddle[:, None], np.clip(points, -1, 1), 0.0)
