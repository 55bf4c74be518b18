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
MIDDLE_GREY = 128.0  # taken off, so that float32 loses less
_ONES = 3  # rows of the design of a patch; after them comes one of ones
NEAR_PX = 1  # by which most patches move at most
CHUNK = 96  # patches computed at once: what they need fits the processor's cache
_SIDE_WEIGHT, _INNER_WEIGHT = np.float32(3 / 32), np.float32(10 / 32)  # of Scharr's operator


@dataclass(frozen=True, slots=True)
class PatchFit:
    """Result for N patches."""

    shift: Array  # (N, 2) px from the prediction
    covariance: Array  # (N, 2, 2) px^2 that the noise of both images leaves
    fits: Flags  # (N,) textured, and moved less than the reach


def fit_patches(templates: Image, cells: Image, groups: Indices, noise_grey: float) -> PatchFit:
    """Fit templates (N, T, T) to the current image's cells (N, C, C), cut where they are predicted.

    The centre of a template is its pixel T // 2, T is TEMPLATE_PX or more. C is WINDOW_PX + 2 reach: a patch that has
    to move by the reach or farther was predicted wrongly, and does not fit.
    groups (N,): patches of one image have one number, and nearly one gain. noise_grey: standard deviation of the
    noise of both images.
    """
    count, reach = len(templates), (cells.shape[1] - WINDOW_PX) // 2
    inner = slice(reach - NEAR_PX, cells.shape[1] - reach + NEAR_PX)
    near = _ShiftedWindows(templates, cells[:, inner, inner])
    normal = near.normal
    trace = normal[:, 0, 0] + normal[:, 1, 1]
    determinant = normal[:, 0, 0] * normal[:, 1, 1] - normal[:, 0, 1] ** 2
    textured = (normal[:, 2, 2] > WINDOW_PX**2 * MIN_CONTRAST**2) & (determinant > MIN_DETERMINANT * trace**2)
    gain = _common_gains(normal[:, 2, 2], near.unshifted_energy(), groups)
    # The prior of the gain, and a diagonal that keeps flat patches from being singular.
    prior = 2 * max(noise_grey, 1.0) ** 2 / GAIN_SIGMA**2
    weighted = normal.copy()
    weighted[:, 2, 2] += prior
    weighted[~textured] += np.eye(3) * (1.0 + trace[~textured, None, None])
    equations = _PatchEquations(np.asarray(np.linalg.inv(weighted)), prior * gain)

    shift, solution, residual = _solve(near, equations, np.zeros((count, 2)), textured)
    # Few patches move far: only theirs are the windows at all shifts.
    far = np.flatnonzero(textured & (np.abs(shift).max(axis=1, initial=0.0) >= NEAR_PX))
    if reach > NEAR_PX and len(far):
        windows = _ShiftedWindows(templates[far], cells[far])
        shift[far], solution[far], residual[far] = _solve(windows, equations.of(far), shift[far], textured[far])
    fits = textured & (np.abs(shift).max(axis=1, initial=0.0) < reach)
    fits &= (solution[:, 2] > GAIN_RANGE[0]) & (solution[:, 2] < GAIN_RANGE[1])
    return PatchFit(shift, _covariance(equations.inverse, residual, np.clip(solution[:, 2], *GAIN_RANGE)), fits)


@dataclass(frozen=True, slots=True)
class _PatchEquations:
    """Normal equations of patches whose right sides depend on the windows."""

    inverse: Array  # (N, 3, 3) of the left sides
    of_gain: Array  # (N,) the prior's part of the right sides

    def of(self, which: Indices) -> _PatchEquations:
        """Return the equations of some patches."""
        return _PatchEquations(self.inverse[which], self.of_gain[which])


def _solve(windows: _ShiftedWindows, equations: _PatchEquations, start: Array, textured: Flags
           ) -> tuple[Array, Array, Array]:
    """Return shifts (N, 2) from a start, solutions (N, 3) and mean squared residuals (N,) of textured (N,) patches.

    The iteration of a patch ends where it converges or leaves the reach of the windows.
    """
    shift, weights = start.copy(), np.zeros((len(start), windows.count))
    solution, projection = np.zeros((len(start), 3)), np.zeros((len(start), 3))
    active = np.flatnonzero(textured)
    for _ in range(ITERATIONS):
        if not len(active):
            break
        weights[active] = of_active = windows.weights(shift[active])
        projection[active] = projected = windows.projected(active, of_active)
        projected[:, 2] += equations.of_gain[active]
        found = (equations.inverse[active] @ projected[:, :, None])[:, :, 0]
        step = found[:, :2] / np.clip(found[:, 2:], *GAIN_RANGE)
        shift[active] += np.clip(step, -1.0, 1.0)
        solution[active] = found
        moving = (np.abs(step).max(axis=1) > CONVERGED_PX) & (np.abs(shift[active]).max(axis=1) < windows.reach)
        active = active[moving]
    # |y - M^T s|^2 of the last step, without computing the differences.
    explained = 2 * projection - (windows.normal @ solution[:, :, None])[:, :, 0]
    residual = np.maximum(windows.energy(weights) - (solution * explained).sum(axis=1), 0.0) / WINDOW_PX**2
    return shift, solution, residual


class _ShiftedWindows:
    """Templates with their gradients, and windows of the current image at the whole shifts around each patch.

    A bilinear window is a weighted sum of four of them, so that its products with template and gradients are the same
    sum of products, which are computed once: an iteration costs a few numbers a patch, and not a window.
    """

    def __init__(self, templates: Image, cells: Image) -> None:
        count, side = len(templates), cells.shape[1]
        self._around = side - WINDOW_PX + 1
        self.reach = self._around // 2  # px
        self.count = self._around**2  # of windows
        # Cells without the columns that a shift leaves out, row after row: a window is a sequence of its pixels.
        self._strips = np.empty((count, self._around, side * WINDOW_PX), np.float32)
        products = np.empty((count, _ONES + 1, _ONES + self.count))
        for start in range(0, count, CHUNK):
            part = slice(start, start + CHUNK)
            self._multiply(templates[part], cells[part], self._strips[part], products[part])
        # The products with ones are sums, by which the others become products about the means.
        self._sums = products[:, _ONES] / WINDOW_PX
        self._products = products[:, :_ONES] - self._sums[:, :_ONES, None] * self._sums[:, None]

    def _multiply(self, templates: Image, cells: Image, strips: Floats, products: Array) -> None:
        """Write strips, and the products (N, 4, 3 + K) of design and ones with design and windows."""
        rows = np.empty((len(templates), _ONES + 1, WINDOW_PX**2), np.float32)
        _design(templates, rows[:, :_ONES].reshape(-1, _ONES, WINDOW_PX, WINDOW_PX))
        rows[:, _ONES] = 1.0
        products[:, :, :_ONES] = rows @ np.swapaxes(rows[:, :_ONES], 1, 2)
        for shift in range(self._around):
            np.subtract(cells[:, :, shift : shift + WINDOW_PX], np.float32(MIDDLE_GREY),
                        out=strips[:, shift].reshape(-1, cells.shape[1], WINDOW_PX))
        for shift in range(self._around):
            windows, first = strips[:, :, WINDOW_PX * shift :][:, :, : WINDOW_PX**2], _ONES + self._around * shift
            products[:, :, first : first + self._around] = rows @ np.swapaxes(windows, 1, 2)

    @property
    def normal(self) -> Array:
        """Products (N, 3, 3) of gradients and template about their means."""
        return self._products[:, :, :_ONES]

    def weights(self, shift: Array) -> Array:
        """Return the weights (N, K) that make a window at shifts (N, 2), bilinear; shifts beyond the reach are cut."""
        steps = np.arange(-self.reach, self.reach + 1)
        along, down = np.maximum(1.0 - np.abs(shift.clip(-self.reach, self.reach).T[:, :, None] - steps), 0.0)
        return np.asarray((down[:, :, None] * along[:, None]).reshape(-1, self.count))

    def projected(self, which: Indices, weights: Array) -> Array:
        """Return the products (M, 3) of gradients and template with the windows of patches which (M,), at weights."""
        return np.asarray((self._products[which, :, _ONES:] @ weights[:, :, None])[:, :, 0])

    def energy(self, weights: Array) -> Array:
        """Return the sums (N,) of the squares of windows about their means, at weights (N, K)."""
        grid = weights.astype(np.float32).reshape(-1, self._around, self._around)
        # Weights are products of those along the columns and those along the rows, which add up to one.
        columns, rows = grid.sum(axis=1), grid.sum(axis=2)
        strips = sum(columns[:, shift, None] * self._strips[:, shift] for shift in range(self._around))
        y = sum(rows[:, shift, None] * strips[:, WINDOW_PX * shift :][:, : WINDOW_PX**2]
                for shift in range(self._around))
        return np.asarray(np.einsum("nk,nk->n", y, y) - (weights * self._sums[:, _ONES:]).sum(axis=1) ** 2, float)

    def unshifted_energy(self) -> Array:
        """Return the same of the windows in the middle."""
        middle = self._around // 2
        y = self._strips[:, middle, WINDOW_PX * middle :][:, : WINDOW_PX**2]
        return np.asarray(np.einsum("nk,nk->n", y, y) - self._sums[:, _ONES + self.count // 2] ** 2, float)


def _design(templates: Image, into: Floats) -> None:
    """Write minus the gradients along column and row, and the window, into (N, 3, WINDOW, WINDOW).

    The gradients are those of Scharr's 3x3 operator. Its sums run over all patches as one line of pixels: what they mix
    across the borders of patches and rows is outside the windows.
    """
    middle, side = templates.shape[1] // 2, TEMPLATE_PX
    around = slice(middle - side // 2, middle + side // 2 + 1)
    line = templates[:, around, around].astype(np.float32).reshape(-1)
    line -= MIDDLE_GREY
    shape = len(templates), side, side
    smooth = []
    for step in (side, 1):
        sums = _INNER_WEIGHT * line
        sums[step:-step] += _SIDE_WEIGHT * (line[2 * step :] + line[: -2 * step])
        smooth.append(sums.reshape(shape))
    inner = slice(1, -1)
    np.subtract(smooth[0][:, inner, :-2], smooth[0][:, inner, 2:], out=into[:, 0])
    np.subtract(smooth[1][:, :-2, inner], smooth[1][:, 2:, inner], out=into[:, 1])
    into[:, 2] = line.reshape(shape)[:, inner, inner]


def _common_gains(energy: Array, current: Array, groups: Indices) -> Array:
    """Return for each patch the median gain (N,) of its group: the ratio of the contrasts.

    energy, current: sums (N,) of the squares of templates and of unshifted windows about their means. A regression
    would be too low, because the template has noise; the ratio of contrasts holds that of both.
    """
    ratio = np.sqrt(current / np.maximum(energy, 1.0))
    order = np.lexsort((ratio, groups))
    _, first, group, count = np.unique(groups[order], return_index=True, return_inverse=True, return_counts=True)
    middle = ratio[order[first + (count - 1) // 2]], ratio[order[first + count // 2]]
    gain = np.empty(len(energy))
    gain[order] = np.clip((middle[0] + middle[1]) / 2, *GAIN_RANGE)[group]
    return gain


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
