"""Local mapping from board to image about a corner, and checks of a board's regularity, pattern and outline."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib.boards.corner_candidates import Grey, sample
from calib.models.camera import Array

# Half side of the square of neighbours that determine the mapping, so many because it has six terms, and some
# neighbours may be missing.
NEIGHBOURS = 2
MIN_NEIGHBOURS = 6
# Variance of the Gaussian weight of neighbours [squares^2], times two, so that the farthest ones have 7 %.
WEIGHT_WIDTH = 3
# Sampling positions within a square, so that they are a pixel away from the edges of the smallest squares
# (MIN_SPACING_PX).
MIDDLE = np.linspace(0.3, 0.7, 5)
# The squares of a print are uniform. A grey step between neighbouring squares counts if it has the right sign and at
# least MIN_STEP of the median step. MIN_STEPS is the least share of such steps (the edge of a shadow spoils some),
# and MAX_SPREAD the largest standard deviation within a square, in parts of the median step.
MIN_STEP = 0.25
MAX_SPREAD, MIN_STEPS = 0.22, 0.6
# Bricks and letters form a few squares by chance, so stricter limits hold for boards of fewer corners than this.
FEW_CORNERS, FEW_MAX_SPREAD, FEW_MIN_STEPS = 20, 0.08, 0.9
# Least share of right steps in the outermost ring of squares.
MIN_AROUND = 0.85
# Largest share, on any side, of steps beyond the board of at least BEYOND_STEP of the median step, because a light
# margin next to the squares yields about a quarter, a pattern that continues 1: the limit is near the middle.
MAX_BEYOND, BEYOND_STEP = 0.65, 0.4


def local_mapping(corners: Array, j: int, i: int, without: bool = False) -> Array | None:
    """Fit coefficients (6, 2) of the image position by 1, x, y, x^2, xy, y^2 of the board [squares] about a corner.

    corners (rows, columns, 2), NaN if unknown; without=True excludes the corner itself. None if too few are known.
    """
    rows, columns = corners.shape[:2]
    first, left = max(0, j - NEIGHBOURS), max(0, i - NEIGHBOURS)
    last, right = min(rows, j + NEIGHBOURS + 1), min(columns, i + NEIGHBOURS + 1)
    near = corners[first:last, left:right].reshape(-1, 2)
    terms, share, is_other = _neighbours((first - j, last - j), (left - i, right - i))
    known = np.isfinite(near[:, 0])
    if without:
        known &= is_other
    if np.count_nonzero(known) < MIN_NEIGHBOURS:
        return None
    weight = (share * known)[:, None]
    A = terms * weight
    coefficients, _, rank, _ = np.linalg.lstsq(A, np.nan_to_num(near) * weight, rcond=1e-6)
    if not without:
        coefficients[0] = corners[j, i]
    return np.asarray(coefficients) if rank == 6 else None


@cache
def _neighbours(rows: tuple[int, int], columns: tuple[int, int]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return monomials (N, 6), weight (N,) and whether it is another corner (N,), of the neighbours of a corner.

    rows, columns: the first and the end of the range of neighbours, relative to the corner.
    """
    y, x = (part.ravel().astype(float) for part in np.mgrid[slice(*rows), slice(*columns)])
    return quadratic_terms(x, y), np.exp(-(x * x + y * y) / WEIGHT_WIDTH), (x != 0) | (y != 0)


def quadratic_terms(x: Array, y: Array) -> Array:
    """Return the monomials 1, x, y, x^2, xy, y^2 (..., 6)."""
    terms = np.empty((*x.shape, 6))
    terms[..., 0], terms[..., 1], terms[..., 2] = 1.0, x, y
    terms[..., 3], terms[..., 4], terms[..., 5] = x * x, x * y, y * y
    return terms


def grid_irregularity(corners: Array) -> Array:
    """Return the distance (rows, columns) of corners from their neighbours' prediction, in squares; NaN: unknown.

    Infinite for all corners if a square is folded, which no image of a board shows.
    """
    off = np.full(corners.shape[:2], np.inf if has_folded_squares(corners) else np.nan)
    for j, i in np.argwhere(np.isfinite(corners[..., 0])):
        mapping = local_mapping(corners, int(j), int(i), without=True)
        if mapping is not None and not np.isinf(off[j, i]):
            size = np.sqrt(abs(np.linalg.det(mapping[1:3])))
            off[j, i] = np.linalg.norm(corners[j, i] - mapping[0]) / max(float(size), 1e-6)
    return off


def prediction_spread(corners: Array) -> Array:
    """Return the standard deviation (rows, columns) of corners about their neighbours' prediction, in parts of theirs.

    It is larger at the edge of the board, where the prediction extrapolates; NaN where there is none.
    """
    spread = np.full(corners.shape[:2], np.nan)
    known = np.isfinite(corners[..., 0])
    padded = np.pad(known, NEIGHBOURS)
    y, x = (part.ravel().astype(float) for part in np.mgrid[-NEIGHBOURS : NEIGHBOURS + 1, -NEIGHBOURS : NEIGHBOURS + 1])
    weight, terms = np.exp(-(x * x + y * y) / WEIGHT_WIDTH) * ((x != 0) | (y != 0)), quadratic_terms(x, y)
    side = 2 * NEIGHBOURS + 1
    for j, i in np.argwhere(known):
        own = weight * padded[j : j + side, i : i + side].ravel()
        if np.count_nonzero(own) >= MIN_NEIGHBOURS:
            # The value at the corner is the constant term of the weighted fit.
            gain = np.linalg.pinv(terms * own[:, None], rcond=1e-6)[0] * own
            spread[j, i] = np.sqrt(1 + gain @ gain)
    return spread


def has_folded_squares(corners: Array) -> bool:
    """True if some square of the corners (rows, columns, 2) has the wrong orientation."""
    along, down = np.diff(corners, axis=1)[:-1], np.diff(corners, axis=0)[:, :-1]
    turning = along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]
    return bool((turning[np.isfinite(turning)] <= 0).any())


def has_checker_pattern(image: Grey, corners: Array) -> bool:
    """True if the squares between corners (rows, columns, 2) are uniform and alternate between dark and light."""
    level, spread = _square_statistics(image, corners)
    sign = np.where(np.indices(level.shape).sum(axis=0) % 2 == 0, -1.0, 1.0)
    down, along = (level[:-1] - level[1:]) * sign[:-1], (level[:, :-1] - level[:, 1:]) * sign[:, :-1]
    steps = np.concatenate([down.ravel(), along.ravel()])
    steps = steps[np.isfinite(steps)]
    if not steps.size:
        return False
    usual = float(np.median(steps))
    alternate = float((steps * np.sign(usual) > MIN_STEP * abs(usual)).mean())
    few = corners.shape[0] * corners.shape[1] < FEW_CORNERS
    least, most = (FEW_MIN_STEPS, FEW_MAX_SPREAD) if few else (MIN_STEPS, MAX_SPREAD)
    return bool(alternate >= least and np.nanmedian(spread) < most * abs(usual))


def outline(image: Grey, corners: Array) -> tuple[bool, bool]:
    """Return whether corners (rows, columns, 2) are a complete and a bounded board.

    Complete: one ring of squares surrounds them, and none follows it; brickwork and chequered floors continue beyond
    that ring. Bounded: no second ring surrounds them; the first may be hidden.
    """
    around, beyond = _outer_steps(image, corners)
    is_bounded = max(_fraction_above(side, BEYOND_STEP) for side in beyond) <= MAX_BEYOND
    return is_bounded and _fraction_above(around, MIN_STEP) >= MIN_AROUND, is_bounded


def _outer_steps(image: Grey, corners: Array) -> tuple[list[Array], list[list[Array]]]:
    """Return the grey steps in the ring of squares around the corners, and of the second ring by side.

    Steps are in parts of the median step within the board, above 0 where the colours alternate.
    """
    level = _square_means(image, corners)
    sign = np.where(np.indices(level.shape).sum(axis=0) % 2 == 0, 1.0, -1.0)
    down, along = np.diff(level, axis=0) * sign[1:], np.diff(level, axis=1) * sign[:, 1:]
    usual = float(np.nanmedian(np.concatenate([down[2:-2, 2:-2].ravel(), along[2:-2, 2:-2].ravel()])))
    down, along = down / usual, along / usual
    beyond = [
        [along[0, 1:-1], down[0, 1:-1]],
        [along[-1, 1:-1], down[-1, 1:-1]],
        [down[1:-1, 0], along[1:-1, 0]],
        [down[1:-1, -1], along[1:-1, -1]],
    ]
    around = [
        along[1, 1:-1],
        along[-2, 1:-1],
        down[1:-1, 1],
        down[1:-1, -2],
        down[1, 1:-1],
        down[-2, 1:-1],
        along[1:-1, 1],
        along[1:-1, -2],
    ]
    return around, beyond


def _fraction_above(steps: Sequence[Array], least: float) -> float:
    """Return the share of steps above a limit; unknown steps (NaN) count as below."""
    return float((np.concatenate(list(steps)) > least).mean())


def _square_means(image: Grey, corners: Array) -> Array:
    """Return the mean grey of the squares between corners (rows, columns, 2) and of two rings around; NaN: unknown."""
    rows, columns = corners.shape[:2]
    level = np.full((rows + 3, columns + 3), np.nan)
    x, y = np.meshgrid(MIDDLE, MIDDLE)
    for row, column in np.ndindex(level.shape):
        j, i = int(np.clip(row - 2, 0, rows - 1)), int(np.clip(column - 2, 0, columns - 1))
        mapping = local_mapping(corners, j, i) if np.isfinite(corners[j, i, 0]) else None
        if mapping is not None:
            level[row, column] = sample(image, quadratic_terms(x + column - 2 - i, y + row - 2 - j) @ mapping).mean()
    return level


def _square_statistics(image: Grey, corners: Array) -> tuple[Array, Array]:
    """Return mean and standard deviation of grey in every square's middle (rows - 1, columns - 1); NaN: unknown."""
    a, b, c, d = (corners[:-1, :-1, None], corners[:-1, 1:, None], corners[1:, :-1, None], corners[1:, 1:, None])
    x, y = (part.ravel()[:, None] for part in np.meshgrid(MIDDLE, MIDDLE))
    places = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
    grey = np.where(np.isfinite(places[..., 0]), sample(image, np.nan_to_num(places)), np.nan)
    return grey.mean(axis=2), grey.std(axis=2)
