"""Patches of planes, as another view shows them: the exact map, in closed form, and the slopes of the planes.

A wall seen aslant is stretched more on its near side than on its far side, and that changes from view to view. Over a
window of 13 px the quadratic part of the map shifts a patch by some hundredths of a pixel, in the same direction for a
whole wall, so that no number of landmarks averages it out: an affine map is not enough.

A plane n . p = 1 is seen from a motion p' = R p + t as n' . (p' - t) = 1 with n' = R n. A ray o' + s u' of the current
view meets it at s = (1 + n' . (t - o')) / (n' . u'), and the first view shows that point at R^T (o' + s u' - t): the
homography of the plane (Hartley and Zisserman 2004, 13.1), here between cylinders. It is evaluated at nine pixels of a
window; between them it is a quadratic polynomial to hundredths of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.panorama import at_pixels
from omnid.core.odometry import patch_kernels
from omnid.core.odometry.patch_kernels import MAX_SLOPE
from omnid.core.odometry.tracking import padded
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

WINDOW_PX = 13  # side of a patch
SLOPE_REACH_PX = 8  # half the side of the window in which the slope of the dense disparity is taken
SAME_SURFACE_PX = 2.0  # disparities that differ by more belong to another surface
# Weight [px^2] of slope zero (an upright surface facing the camera) in the least squares: a full window has 6936, so
# that its slope is 0.7 % too flat.
SLOPE_PRIOR = 50.0
# Side of the window in which slopes are fitted, by trial on development logs: in a smaller one they are noisier, a
# larger one leaves the plane.
SLOPE_WINDOW_PX, SLOPE_ROUNDS = 21, 2
# Standard deviation [px/px] of the slopes by dense stereo, which are a third too flat, because its windows are upright.
SLOPE_SIGMA = 0.1
REACH_PX = 1  # largest distance of an aligned patch from its prediction, if pose and depth are known well
CROSS_PX = 0.5  # largest lateral distance of an aligned patch in the upper panorama from its tracked pixel


@dataclass(frozen=True, slots=True)
class AlignedPatches:
    """Positions of N patches in a panorama."""

    pixels: Array  # (N, 2)
    covariance: Array  # (N, 2, 2) px^2 that the noise leaves
    found: Flags  # (N,) textured, and near the prediction


def plane_templates(
    image: PaddedPanorama,
    pixels: Array,
    surfaces: tuple[Array, Array],
    T_curr_ref: Array,
    predicted: Array,
    model: StereoModel,
    *,
    upper: bool = False,
    window_px: int = WINDOW_PX,
) -> Floats:
    """Return templates (N, T, T) of patches at pixels (N, 2) of an image as the current view shows them, less grey 128.

    They hold the window and the border that the gradient's 3x3 operator needs.

    surfaces: points (N, 3) [m] at the patches' centres and slopes (N, 2) of the disparity there, both in the rectified
    frame of the image; T_curr_ref (4, 4) from it. upper: the current panorama is the upper one. The templates' pixels
    are whole pixels of the current panorama, which shows the centres at predicted (N, 2). Where a plane is seen edge
    on, or explains a part alone, the patch is not bent.
    """
    templates = np.empty((len(pixels), window_px + 2, window_px + 2), np.float32)
    lengths = model.cylinder.focal_px, model.baseline_m, model.baseline_m if upper else 0.0
    planes = np.column_stack([*surfaces, predicted])
    patch_kernels.sample(image.image, padded(image, pixels), planes, T_curr_ref, lengths, templates)
    return templates


def disparity_slopes(disparity: Floats, points: Array, centre: Array) -> Array:
    """Return slopes (N, 2) of the disparity [px/px] along column and row at points (N, 2) with disparity centre (N,).

    A plane through the centre by regularised least squares; neighbours that differ by more than SAME_SURFACE_PX are
    left out, and all where the centre is NaN. Dense stereo matches upright windows, so these slopes are too flat.
    """
    offsets = np.arange(-SLOPE_REACH_PX, SLOPE_REACH_PX + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offsets, offsets))
    change = at_pixels(disparity, np.rint(points)[:, None] + np.column_stack([dx, dy])) - centre[:, None]
    near = np.abs(change) < SAME_SURFACE_PX
    change = np.where(near, change, 0.0)
    xx, yy, xy = near @ (dx * dx) + SLOPE_PRIOR, near @ (dy * dy) + SLOPE_PRIOR, near @ (dx * dy)
    x, y = change @ dx, change @ dy
    return np.asarray(np.column_stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy**2)[:, None])


def fitted_slopes(
    pair: tuple[PaddedPanorama, PaddedPanorama], pixels: Array, near: Array, start: Array, model: StereoModel
) -> Array:
    """Return slopes (N, 2) of the disparity at pixels (N, 2) of the lower panorama, seen near (N, 2) in the upper one.

    start (N, 2): slopes by dense stereo, a weak prior; they are returned where near is NaN or the fit fails. A plane
    warps the lower window into the upper one. Shift, two slopes, gain and offset are fitted by Gauss-Newton with the
    gradient of the lower window, which each round warps again. Dense slopes are a third too flat and scatter by 0.05:
    with them a patch seen from elsewhere would be shifted by tenths of a pixel.
    """
    known, slopes = np.flatnonzero(np.isfinite(near).all(axis=1)), start.copy()
    found, fits, predicted = start[known], np.ones(len(known), bool), near[known]
    for _ in range(SLOPE_ROUNDS):
        templates = _in_upper(pair, pixels[known], predicted, found, model, SLOPE_WINDOW_PX)
        change = start[known] - found
        fitted = align(templates, pair[1], predicted, REACH_PX, change, SLOPE_SIGMA)
        fits &= fitted.found
        found, predicted = found + change, fitted.pixels
    fits &= (np.abs(found) < MAX_SLOPE).all(axis=1)
    slopes[known[fits]] = found[fits]
    return slopes


def _in_upper(
    pair: tuple[PaddedPanorama, PaddedPanorama],
    pixels: Array,
    predicted: Array,
    slopes: Array,
    model: StereoModel,
    window_px: int = WINDOW_PX,
) -> Floats:
    """Return templates of the lower panorama's patches at pixels (N, 2) as the upper one shows them at predicted."""
    points = triangulate(np.column_stack([pixels, predicted[:, 1]]), model.cylinder, model.baseline_m)
    surfaces = points, slopes
    return plane_templates(pair[0], pixels, surfaces, np.eye(4), predicted, model, upper=True, window_px=window_px)


def align(
    templates: Floats,
    current: PaddedPanorama,
    predicted: Array,
    reach_px: int = REACH_PX,
    slopes: Array | None = None,
    slope_sigma: float = 0.0,
) -> AlignedPatches:
    """Align templates (N, T, T), centred on predicted (N, 2), with the current panorama.

    reach_px: a patch that has to move this far was predicted wrongly. slopes (N, 2): prior of their change, which is
    written; slope_sigma: its standard deviation, 0: they do not change.
    """
    count, centres = len(templates), padded(current, np.rint(predicted))
    slopes = np.zeros((count, 2)) if slopes is None else slopes
    shift, covariance, found = np.empty((count, 2)), np.empty((count, 2, 2)), np.empty(count, bool)
    noise_grey, results = current.noise_grey, (shift, slopes, covariance, found)
    patch_kernels.fit(templates, current.image, centres, noise_grey, reach_px, slope_sigma, *results)
    return AlignedPatches(predicted + shift, covariance, found)


def align_rows(
    pair: tuple[PaddedPanorama, PaddedPanorama],
    points: Array,
    near: Array,
    slopes: Array,
    model: StereoModel,
    reach_px: int = REACH_PX,
    spread_px: Array | float = 0.0,
) -> tuple[Array, Array]:
    """Align patches of the lower panorama at points (N, 2) with the upper one near pixels (N, 2), NaN where unknown.

    slopes (N, 2) of the disparity; reach_px: largest distance from the pixels; spread_px (N,): two standard deviations
    of their columns. Returns the rows (N,), NaN where no patch fits, and their variances (N,) [px^2] by the noise. Gain
    and offset of the two cameras may differ.
    """
    known = np.flatnonzero(near[:, 1] > points[:, 1])
    pixels, predicted = points[known], near[known]
    found = align(_in_upper(pair, pixels, predicted, slopes[known], model), pair[1], predicted, reach_px)
    largest_px = CROSS_PX + np.broadcast_to(spread_px, len(points))[known]
    fits = found.found & (np.abs(found.pixels[:, 0] - predicted[:, 0]) < largest_px)
    fits &= found.pixels[:, 1] > pixels[:, 1]
    aligned, variance = np.full(len(points), np.nan), np.zeros(len(points))
    aligned[known[fits]], variance[known[fits]] = found.pixels[fits, 1], found.covariance[fits, 1, 1]
    return aligned, variance


def view_noise(covariance: Array, row_variance: Array) -> Array:
    """Return covariances (N, 3, 3) [px^2] of views whose upper row is the lower row plus a disparity.

    covariance (N, 2, 2) or (2, 2) of the pixels in the lower panorama, row_variance (N,) of the disparities.
    """
    noise = np.broadcast_to(covariance, (len(row_variance), 2, 2))[:, [0, 1, 1]][:, :, [0, 1, 1]]
    noise[:, 2, 2] += row_variance
    return noise
