"""How the corners of a board lie among their neighbours: the local mapping from board to image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.boards.corner_candidates import Grey, sample
from calib.models.camera import Array

# Neighbours in a square of this half side shape the mapping; it has six terms and a corner may lack some of them.
NEIGHBOURS = 2
MIN_NEIGHBOURS = 6
# Of a print every square is plain: within its middle part grey levels spread by less than this part of the step to the
# squares beside it, and so many of those steps go the right way, and are no less than a part of the usual one (the edge
# of a shadow spoils some). Bricks and letters make a few squares by chance: a board of so few corners has to be clean.
MIDDLE = np.linspace(0.3, 0.7, 5)
MIN_STEP = 0.25
MAX_SPREAD, MIN_STEPS = 0.22, 0.6
FEW_CORNERS, FEW_MAX_SPREAD, FEW_MIN_STEPS = 20, 0.08, 0.9
# A board ends: the squares around its corners' own are there, so many of their steps go the right way, and on no side
# do the squares go on beyond, by so many steps of this part of the usual one. A light margin has a quarter of them.
MIN_AROUND = 0.85
MAX_BEYOND, BEYOND_STEP = 0.65, 0.4


def local_mapping(corners: Array, j: int, i: int, without: bool = False) -> Array | None:
    """Coefficients (6, 2) of the image's place by 1, x, y, x^2, xy, y^2 of the board's [squares] about a corner.

    corners (rows, columns, 2), NaN where unknown; without: from its neighbours alone. None: too few of them.
    """
    rows, columns = corners.shape[:2]
    y, x = np.mgrid[max(0, j - NEIGHBOURS):min(rows, j + NEIGHBOURS + 1),
                    max(0, i - NEIGHBOURS):min(columns, i + NEIGHBOURS + 1)]
    near = corners[y, x].reshape(-1, 2)
    x, y = (x - i).ravel().astype(float), (y - j).ravel().astype(float)
    known = np.isfinite(near[:, 0]) & ((x != 0) | (y != 0) | (not without))
    if known.sum() < MIN_NEIGHBOURS:
        return None
    weight = (np.exp(-(x * x + y * y) / 3) * known)[:, None]
    A = terms(x, y) * weight
    coefficients, _, rank, _ = np.linalg.lstsq(A, np.nan_to_num(near) * weight, rcond=1e-6)
    if not without:
        coefficients[0] = corners[j, i]
    return np.asarray(coefficients) if rank == 6 else None


def terms(x: Array, y: Array) -> Array:
    """1, x, y, x^2, xy, y^2 (..., 6)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def unevenness(corners: Array) -> Array:
    """How far (rows, columns) every corner is from where its neighbours expect it, in parts of a square; NaN: unknown.

    Infinite all over where squares fold over, as those of no board do.
    """
    off = np.full(corners.shape[:2], np.inf if folds(corners) else np.nan)
    for j, i in np.argwhere(np.isfinite(corners[..., 0])):
        mapping = local_mapping(corners, int(j), int(i), without=True)
        if mapping is not None and not np.isinf(off[j, i]):
            size = np.sqrt(abs(np.linalg.det(mapping[1:3])))
            off[j, i] = np.linalg.norm(corners[j, i] - mapping[0]) / max(float(size), 1e-6)
    return off


def folds(corners: Array) -> bool:
    """Whether some square of the corners (rows, columns, 2) turns the other way than it must."""
    along, down = np.diff(corners, axis=1)[:-1], np.diff(corners, axis=0)[:, :-1]
    turning = along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0]
    return bool((turning[np.isfinite(turning)] <= 0).any())


def is_printed(image: Grey, corners: Array) -> bool:
    """Whether the squares between corners (rows, columns, 2) are plain, and dark and light by turns."""
    level, spread = _squares(image, corners)
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


def is_whole(image: Grey, corners: Array) -> bool:
    """Whether a board of these corners (rows, columns, 2) ends where it must: brickwork and chequered floors go on."""
    level = _levels(image, corners)
    sign = np.where(np.indices(level.shape).sum(axis=0) % 2 == 0, 1.0, -1.0)
    down, along = np.diff(level, axis=0) * sign[1:], np.diff(level, axis=1) * sign[:, 1:]
    usual = float(np.nanmedian(np.concatenate([down[2:-2, 2:-2].ravel(), along[2:-2, 2:-2].ravel()])))
    down, along = down / usual, along / usual
    beyond = ((along[0, 1:-1], down[0, 1:-1]), (along[-1, 1:-1], down[-1, 1:-1]),
              (down[1:-1, 0], along[1:-1, 0]), (down[1:-1, -1], along[1:-1, -1]))
    around = (along[1, 1:-1], along[-2, 1:-1], down[1:-1, 1], down[1:-1, -2], down[1, 1:-1], down[-2, 1:-1],
              along[1:-1, 1], along[1:-1, -2])
    goes_on = max(_share(side, BEYOND_STEP) for side in beyond) > MAX_BEYOND
    return _share(around, MIN_STEP) >= MIN_AROUND and not goes_on


def _share(steps: Sequence[Array], least: float) -> float:
    """The part of the steps that are more than that; what is not known is not."""
    return float((np.concatenate(list(steps)) > least).mean())


def _levels(image: Grey, corners: Array) -> Array:
    """Mean grey of the squares between corners (rows, columns, 2) and of two more all around; NaN: unknown."""
    rows, columns = corners.shape[:2]
    level = np.full((rows + 3, columns + 3), np.nan)
    x, y = np.meshgrid(MIDDLE, MIDDLE)
    for row, column in np.ndindex(level.shape):
        j, i = int(np.clip(row - 2, 0, rows - 1)), int(np.clip(column - 2, 0, columns - 1))
        mapping = local_mapping(corners, j, i) if np.isfinite(corners[j, i, 0]) else None
        if mapping is not None:
            level[row, column] = sample(image, terms(x + column - 2 - i, y + row - 2 - j) @ mapping).mean()
    return level


def _squares(image: Grey, corners: Array) -> tuple[Array, Array]:
    """Mean grey and its standard deviation in the middle of every square (rows - 1, columns - 1); NaN: unknown."""
    a, b, c, d = (corners[:-1, :-1, None], corners[:-1, 1:, None], corners[1:, :-1, None], corners[1:, 1:, None])
    x, y = (part.ravel()[:, None] for part in np.meshgrid(MIDDLE, MIDDLE))
    places = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d)
    grey = np.where(np.isfinite(places[..., 0]), sample(image, np.nan_to_num(places)), np.nan)
    return grey.mean(axis=2), grey.std(axis=2)
