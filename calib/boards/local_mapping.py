"""The mapping from a board to its image about a place: it refines corners, and shows those that are off.

Edges in a mirror image are curved and squares sheared, so a window that is straight in the image biases the corner.
The mapping comes from the neighbours, to third order at most, or exactly from a first calibration. Without that second
pass calibrated cameras are about 0.04 % too large.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.boards.board import WINDOW, AnyBoard
from calib.boards.corner_candidates import Grey, sample
from calib.models.camera import Array
from calib.models.ocam import OcamCamera

# Mappings of the board to the image about corners: of the numbers (M,) of corners, and offsets (M, K, 2) [squares] from
# each of these, to pixels (M, K, 2).
ToImage = Callable[[NDArray[np.intp], Array], Array]
# Reach of a mapping [squares]; the Gaussian weight of its points is half as wide.
REACH = 3.0
# Least numbers of points of a mapping of third, second and first order, which has 10, 6 and 3 terms.
ORDERS = ((10, 16), (6, 10), (3, 4))
# Least ratio of the mapping's singular values.
MIN_CONDITION = 0.02
# A place lies at most this far from the nearest known point [squares].
MAX_AHEAD = 1.1
# Largest distance of a corner from the mapping of the others: in squares, and in pixels added to it.
MAX_IRREGULARITY, MAX_IRREGULARITY_PX = 0.1, 0.4
# Largest half side of the window in pixels, because farther grey levels do not depend on the corner's position.
REACH_PX = 8
# Width of the window's Gaussian weight as a fraction of its half side: a baseline of 180 mm is 0.21 mm off with 0.7,
# 0.08 mm with 0.6.
WEIGHT_PART = 0.6
# A last step is a fifth of the accuracy.
MAX_ITERATIONS, CONVERGED_PX = 4, 2e-3


@dataclass(frozen=True, slots=True)
class LocalMapping:
    """Coefficients (6, 2) of pixels by 1, x, y, x^2, xy, y^2 about a place of a board [squares].

    gain: ratio of the standard deviations of the place's pixel and of the points' pixels; above 1 beyond their outline,
    infinite for a mapping of first order, which does not hold the curvature of a mirror image.
    """

    coefficients: Array
    gain: float

    @property
    def side_px(self) -> float:
        """Return the narrower side of a square [px]."""
        return float(np.linalg.svd(self.coefficients[1:3], compute_uv=False)[-1])


def local_mapping(place: Array, at: Array, where: Array, *, exact: bool = False) -> LocalMapping | None:
    """Fit the mapping from the board to the image about a place (2,) [squares] of the board.

    at (M, 2) [squares], where (M, 2) [px]: known points; exact: they are refined corners, whose third order is fitted
    too. None if too few are near, or all on one side far away.
    """
    offset = at - place
    distance = np.linalg.norm(offset, axis=1)
    near = np.flatnonzero(distance < REACH)
    if not len(near) or distance[near].min() > MAX_AHEAD:
        return None
    weight = np.exp(-2 * (distance[near] / REACH) ** 2)[:, None]
    x, y = offset[near].T
    terms = np.column_stack([quadratic_terms(x, y), x**3, x * x * y, x * y * y, y**3])
    for count, least in ORDERS if exact else ORDERS[1:]:
        if len(near) < least:
            continue
        left, values, right = np.linalg.svd(terms[:, :count] * weight, full_matrices=False)
        if values[-1] > MIN_CONDITION * values[0]:
            inverse = (right.T / values) @ left.T * weight.T
            coefficients = np.vstack([(inverse @ where[near])[:6], np.zeros((max(0, 6 - count), 2))])
            return LocalMapping(coefficients, float(np.linalg.norm(inverse[0])) if count > 3 else np.inf)
    return None


def quadratic_terms(x: Array, y: Array) -> Array:
    """Return the monomials 1, x, y, x^2, xy, y^2 (..., 6)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def mapping_of_others(points: Array, pixels: Array, k: int) -> LocalMapping | None:
    """Return the mapping about corner k by the others that are known: points (N, 2) [squares], pixels (N, 2)."""
    others = np.isfinite(pixels[:, 0])
    others[k] = False
    return local_mapping(points[k], points[others], pixels[others], exact=True)


def predicted_corners(grey: Grey, mappings: Sequence[LocalMapping], window: float) -> tuple[Array, Array]:
    """Return the corners (M, 2) [px] that an image shows where mappings predict them, and their moves (M,) [squares].

    window: half side [squares]; a corner is not sought farther than that.
    """
    own = np.array([mapping.coefficients for mapping in mappings])

    def to_image(which: NDArray[np.intp], xy: Array) -> Array:
        return np.asarray(quadratic_terms(xy[..., 0], xy[..., 1]) @ own[which])

    shift = _corner_shifts(grey, to_image, len(mappings), window)
    pixels = to_image(np.arange(len(mappings)), shift[:, None])[:, 0]
    return pixels, np.abs(shift).max(axis=1)


def refined_corners(image: NDArray[np.uint8], points: Array, pixels: Array, window: float = WINDOW) -> Array:
    """Return pixels (N, 2) moved onto the image's corners; those without enough neighbours stay, NaN as well.

    points (N, 2) [squares]: the corners on the board; window: half side [squares].
    """
    grey, refined = image.astype(np.float32), pixels.copy()
    for _ in range(MAX_ITERATIONS):
        known = np.flatnonzero(np.isfinite(refined[:, 0])).tolist()
        mappings = {k: found for k in known if (found := mapping_of_others(points, refined, k)) is not None}
        if not mappings:
            break
        # About the corner where it was found: the others only tell the shape of the window.
        chosen = list(mappings)
        own = [
            LocalMapping(np.vstack([refined[k], found.coefficients[1:]]), found.gain) for k, found in mappings.items()
        ]
        moved, _ = predicted_corners(grey, own, window)
        step_px = float(np.linalg.norm(moved - refined[chosen], axis=1).max())
        refined[chosen] = moved
        if step_px < CONVERGED_PX:
            break
    return refined


def without_outliers(points: Array, pixels: Array) -> Array:
    """Return pixels (N, 2) with NaN for those that are off the mapping of the others, the worst first.

    Outside of the others' outline the mapping determines a corner less well.
    """
    good = pixels.copy()

    def off(k: int) -> float:
        mapping = mapping_of_others(points, good, k)
        if mapping is None:
            return np.inf
        limit = (MAX_IRREGULARITY * mapping.side_px + MAX_IRREGULARITY_PX) * max(1.0, mapping.gain) ** 2
        return float(np.linalg.norm(mapping.coefficients[0] - good[k]) / limit)

    for _ in range(len(points)):
        offs = {k: off(k) for k in np.flatnonzero(np.isfinite(good[:, 0])).tolist()}
        worst = max(offs, key=lambda k: offs[k], default=None)
        if worst is None or offs[worst] < 1:
            break
        good[worst] = np.nan  # one at a time: an outlier spoils the mappings of its neighbours
    return good


def refine_with_camera(
    image: NDArray[np.uint8], pixels: Array, board: AnyBoard, camera: OcamCamera, T_cam_board: Array
) -> Array:
    """Move the pixels (N, 2) of a board's corners onto those of the image, with a camera as the mapping."""
    seen = np.flatnonzero(np.isfinite(pixels[:, 0]))
    points = board.points[seen]

    def to_image(which: NDArray[np.intp], xy: Array) -> Array:
        at = points[which, None] + board.square_m * np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=2)
        return camera.project_near(se3.apply(T_cam_board, at.reshape(-1, 3))).reshape(xy.shape)

    shift = _corner_shifts(image.astype(np.float32), to_image, len(seen), board.window)
    refined = pixels.copy()
    refined[seen] = to_image(np.arange(len(seen)), shift[:, None])[:, 0]
    return refined


def _corner_shifts(grey: Grey, to_image: ToImage, count: int, window: float) -> Array:
    """Return the shifts (count, 2) [squares] of corners to those of the image, by repeated steps.

    It is 0 for those that leave the window: they have reached another edge.
    """
    shift = np.zeros((count, 2))
    for _ in range(MAX_ITERATIONS):
        step = _corner_offsets(grey, to_image, shift, window)
        shift = shift + step
        if not (np.abs(step) * _squares_px(to_image, shift, window)[:, None] > CONVERGED_PX).any():
            break
    return np.where(np.abs(shift).max(axis=1, keepdims=True) < window, shift, 0.0)


def _squares_px(to_image: ToImage, shift: Array, window: float) -> Array:
    """Return the sides (M,) of the squares at corners that are shifted (M, 2) [squares], in pixels, over a window."""
    ends = to_image(np.arange(len(shift)), shift[:, None] + window * np.array([[0.0, 0], [1, 0], [0, 1]]))
    return np.asarray(np.sqrt(np.abs(np.linalg.det((ends[:, 1:] - ends[:, :1]) / window))))


def _corner_offsets(grey: Grey, to_image: ToImage, shift: Array, window: float) -> Array:
    """Return the offsets (M, 2) [squares] of the corners in windows about places that are shifted (M, 2)."""
    size = _squares_px(to_image, shift, window)
    reach = np.minimum(window, REACH_PX / np.maximum(size, 1e-6))
    # An odd number of samples along a side, about one a pixel; 5 at least, as the surface has six terms.
    side = np.clip(np.ceil(2 * reach * np.nan_to_num(size)), 5, 2 * REACH_PX).astype(int) // 2 * 2 + 1
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
    """Return the samples (K, 2) of a window as a fraction of its half side, their weights (K,), and the matrix (6, K)
    that maps weighted grey levels to the terms of the surface of second order.
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
