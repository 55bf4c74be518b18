"""Shift, gain and offset between patches of two images by least squares, with the covariance of the shift.

The exposure of a camera may change from image to image and differs between two cameras, and vignetting changes the
brightness of a point that moves across the image. So each patch has a gain and an offset of its own: with template t,
its gradient g, and the current patch c, c(x + d) = a t(x) + b is solved for d, a and b by Gauss-Newton with the
template's gradient (Lucas and Kanade 1981; gain and offset as in Jin, Favaro, Soatto 2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

WINDOW_PX = 13
TEMPLATE_PX = WINDOW_PX + 2  # holds the window and the gradient's border
CELL_PX = 20  # of the current image: holds the window, the largest shift and the interpolation's border
MAX_SHIFT_PX = 2.0  # a patch that has to move farther was predicted wrongly
ITERATIONS, CONVERGED_PX = 12, 0.004
GAIN_SIGMA = 0.05  # of a patch about the gain of all patches of its image: vignetting, slanted light
GAIN_RANGE = (0.25, 4.0)  # between two images whose exposures were made equal before
MIN_CONTRAST = 0.5  # grey levels, standard deviation in a window: less is no texture
MIN_DETERMINANT = 1e-3  # of the gradients' matrix by the square of its trace: less is an edge that slides along itself
# Interpolation makes the noise of neighbouring pixels alike: a sum over a window of a panorama varies so much more.
NOISE_CORRELATION = 3.0
# Variance of a gradient of the panorama's noise per variance of the noise: it enlarges the gradients' matrix.
GRADIENT_NOISE = 0.12
MIN_TRUE_GRADIENT = 0.2  # least share of the gradients' matrix that counts as texture
_HALF = WINDOW_PX // 2
_CENTRE = CELL_PX // 2
_INNER = slice(_CENTRE - _HALF, _CENTRE + _HALF + 1)


@dataclass(frozen=True, slots=True)
class PatchFit:
    """Result for N patches."""

    shift: Array  # (N, 2) px from the prediction
    covariance: Array  # (N, 2, 2) px^2 that the noise of both images leaves
    fits: Flags  # (N,) textured, and moved less than MAX_SHIFT_PX


def fit_patches(templates: Image, cells: Image, groups: Indices, noise_grey: float) -> PatchFit:
    """Fit templates (N, T, T) to the current image's cells (N, CELL, CELL), cut where they are predicted.

    The centre of a template is its pixel T // 2, T is TEMPLATE_PX or more.
    groups (N,): patches of one image have one number, and nearly one gain. noise_grey: standard deviation of the
    noise of both images.
    """
    count = len(templates)
    M = _design(templates)
    normal = (M @ np.swapaxes(M, 1, 2)).astype(float)
    unweighted = normal.copy()
    trace = normal[:, 0, 0] + normal[:, 1, 1]
    determinant = normal[:, 0, 0] * normal[:, 1, 1] - normal[:, 0, 1] ** 2
    textured = (normal[:, 2, 2] > M.shape[2] * MIN_CONTRAST**2) & (determinant > MIN_DETERMINANT * trace**2)
    gain = _common_gains(normal[:, 2, 2], cells, groups)
    # The prior of the gain, and a diagonal that keeps flat patches from being singular.
    prior = 2 * max(noise_grey, 1.0) ** 2 / GAIN_SIGMA**2
    normal[:, 2, 2] += prior
    normal[~textured] += np.eye(3) * (1.0 + trace[~textured, None, None])
    inverse = np.linalg.inv(normal)

    current = cells.astype(np.float32)
    shift = np.zeros((count, 2))
    solution, projection, energy = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
    active = np.flatnonzero(textured)
    for _ in range(ITERATIONS):
        if not len(active):
            break
        y = _shifted(current, active, shift[active])
        y -= y.mean(axis=1, keepdims=True)
        projected = (M[active] @ y[:, :, None])[:, :, 0].astype(float)
        projection[active], energy[active] = projected, np.einsum("nk,nk->n", y, y)
        projected[:, 2] += prior * gain[active]
        found = (inverse[active] @ projected[:, :, None])[:, :, 0]
        step = found[:, :2] / np.clip(found[:, 2:], *GAIN_RANGE)
        shift[active] += np.clip(step, -1.0, 1.0)
        solution[active] = found
        moving = (np.abs(step).max(axis=1) > CONVERGED_PX) & (np.abs(shift[active]).max(axis=1) < MAX_SHIFT_PX)
        active = active[moving]
    fits = textured & (np.abs(shift).max(axis=1, initial=0.0) < MAX_SHIFT_PX)
    fits &= (solution[:, 2] > GAIN_RANGE[0]) & (solution[:, 2] < GAIN_RANGE[1])
    # |y - M^T s|^2 of the last step, without computing the differences.
    explained = 2 * projection - (unweighted @ solution[:, :, None])[:, :, 0]
    residual = np.maximum(energy - (solution * explained).sum(axis=1), 0.0) / WINDOW_PX**2
    return PatchFit(shift, _covariance(inverse, residual, np.clip(solution[:, 2], *GAIN_RANGE)), fits)


def _design(templates: Image) -> Floats:
    """Return (N, 3, WINDOW * WINDOW): minus the gradients along column and row, and the window, each of mean 0.

    The gradients are those of Scharr's 3x3 operator.
    """
    middle = templates.shape[1] // 2
    around = slice(middle - _HALF - 1, middle + _HALF + 2)
    a = templates[:, around, around].astype(np.float32)
    side, inner = np.float32(3 / 32), np.float32(10 / 32)
    down = side * (a[:, :-2] + a[:, 2:]) + inner * a[:, 1:-1]
    across = side * (a[:, :, :-2] + a[:, :, 2:]) + inner * a[:, :, 1:-1]
    M = np.empty((len(a), 3, WINDOW_PX, WINDOW_PX), np.float32)
    np.subtract(down[:, :, :-2], down[:, :, 2:], out=M[:, 0])
    np.subtract(across[:, :-2], across[:, 2:], out=M[:, 1])
    M[:, 2] = a[:, 1:-1, 1:-1]
    flat = M.reshape(-1, 3, WINDOW_PX**2)
    flat -= flat.mean(axis=2, keepdims=True)
    return flat


def _common_gains(energy: Array, cells: Image, groups: Indices) -> Array:
    """Return for each patch the median gain (N,) of its group: the ratio of the contrasts.

    A regression would be too low, because the template has noise; the ratio of contrasts holds that of both.
    """
    current = cells[:, _INNER, _INNER].reshape(-1, WINDOW_PX**2).astype(np.float32)
    current -= current.mean(axis=1, keepdims=True)
    ratio = np.sqrt(np.einsum("nk,nk->n", current, current) / np.maximum(energy, 1.0))
    gain = np.ones(len(cells))
    for group in np.unique(groups).tolist():
        own = groups == group
        gain[own] = np.clip(np.median(ratio[own]), *GAIN_RANGE)
    return gain


def _shifted(cells: Floats, which: Indices, shift: Array) -> Floats:
    """Return the windows (M, WINDOW * WINDOW) of some cells, which (M,) of (N, CELL, CELL), at shifts (M, 2), bilinear.
    """
    clipped = np.clip(shift, -MAX_SHIFT_PX, MAX_SHIFT_PX)
    whole = np.floor(clipped).astype(np.intp)
    fx, fy = (clipped - whole).astype(np.float32).T[:, :, None, None]
    first = (_CENTRE - _HALF + whole[:, 1]) * CELL_PX + _CENTRE - _HALF + whole[:, 0]
    grid = (np.arange(WINDOW_PX + 1)[:, None] * CELL_PX + np.arange(WINDOW_PX + 1)).ravel()
    index = (which * CELL_PX**2 + first)[:, None] + grid
    block = np.take(cells.reshape(-1), index).reshape(-1, WINDOW_PX + 1, WINDOW_PX + 1)
    rows = (1 - fy) * block[:, :-1] + fy * block[:, 1:]
    windows = (1 - fx) * rows[:, :, :-1] + fx * rows[:, :, 1:]
    return np.asarray(windows.reshape(-1, WINDOW_PX**2), np.float32)


def _covariance(inverse: Array, residual: Array, gain: Array) -> Array:
    """Return the covariance (N, 2, 2) [px^2] of shifts from the mean squared residual (N,) and the fitted gain (N,)."""
    pixels = WINDOW_PX**2
    variance = residual * pixels / (pixels - 4)
    spread = inverse[:, :2, :2]
    # Noise in the template looks like texture: its part of the gradients' matrix is taken off.
    trace = (inverse[:, 0, 0] + inverse[:, 1, 1]) / np.maximum(
        inverse[:, 0, 0] * inverse[:, 1, 1] - inverse[:, 0, 1] ** 2, 1e-12)
    noise = GRADIENT_NOISE * pixels * variance / 2 / gain**2
    texture = np.clip(1 - 2 * noise / np.maximum(trace, 1e-9), MIN_TRUE_GRADIENT, 1.0)
    return np.asarray(NOISE_CORRELATION * (variance / gain**2 / texture)[:, None, None] * spread)
