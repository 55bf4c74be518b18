"""Alignment of landmarks' patches, warped to the new viewpoint, to hundredths of a pixel.

Plain Lucas-Kanade shifts a window but does not warp it, and errs by tenths of a pixel as soon as the camera has moved
some decimetres. Here each keyframe patch is warped as pose, depth and slope of its surface predict (`plane_patches`),
and `patch_fit` finds the remaining shift together with a gain and an offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.patch_fit import WINDOW_PX, PatchFit, fit_patches
from omnid.core.odometry.patch_kernels import cut
from omnid.core.odometry.plane_patches import plane_templates
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Indices = NDArray[np.intp]

# Reach of patches whose pose and depth are known well, the least there is, because cells have whole pixels.
REACH_PX = 1
# By which a patch may move sideways in the upper panorama from where it was tracked to.
CROSS_PX = 0.5


@dataclass(frozen=True, slots=True)
class AlignedPatches:
    """Positions of N patches in a panorama."""

    pixels: Array  # (N, 2)
    covariance: Array  # (N, 2, 2) px^2 that the noise leaves
    found: NDArray[np.bool_]  # (N,) textured, and near the prediction

    @staticmethod
    def of(fit: PatchFit, predicted: Array) -> AlignedPatches:
        """Return the pixels of patches that were cut at predicted (N, 2)."""
        return AlignedPatches(predicted + fit.shift, fit.covariance, fit.fits)


def align(
    templates: Image, current: PaddedPanorama, predicted: Array, groups: Indices, reach_px: int = REACH_PX
) -> AlignedPatches:
    """Align templates (N, TEMPLATE, TEMPLATE), centred on predicted (N, 2), with the current panorama.

    groups (N,): patches that come from one image have one number. reach_px: a patch that has to move this far was
    predicted wrongly.
    """
    cells = _cut(current, np.rint(predicted), WINDOW_PX + 2 * reach_px)
    return AlignedPatches.of(fit_patches(templates, cells, groups, current.noise_grey), predicted)


def align_rows(
    pair: tuple[PaddedPanorama, PaddedPanorama], points: Array, near: Array, slopes: Array, model: StereoModel
) -> tuple[Array, Array]:
    """Align patches of the lower panorama at points (N, 2) with the upper one near pixels (N, 2), NaN where unknown.

    slopes (N, 2) of the disparity. Returns the rows (N,), NaN where no patch fits, and their variances (N,) [px^2] by
    the noise. Gain and offset of the two cameras may differ.
    """
    known = np.flatnonzero(near[:, 1] > points[:, 1])
    pixels, predicted = points[known], near[known]
    in_space = triangulate(np.column_stack([pixels, predicted[:, 1]]), model.cylinder, model.baseline_m)
    one, still = np.zeros(len(known), np.intp), np.tile(np.eye(4), (len(known), 1, 1))
    templates = plane_templates(
        {0: pair[0]}, one, pixels, (in_space, slopes[known]), still, model, predicted, upper=True
    )
    found = align(templates, pair[1], predicted, one)
    fits = found.found & (np.abs(found.pixels[:, 0] - predicted[:, 0]) < CROSS_PX)
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


def _cut(panorama: PaddedPanorama, centres: Array, side_px: int) -> Image:
    """Return cells (N, side, side) around whole pixels (N, 2), also across the seam; the border is repeated."""
    cells = np.empty((len(centres), side_px, side_px), np.uint8)
    cut(panorama.image, np.column_stack([panorama.padded(centres[:, 0]), centres[:, 1]]), cells)
    return cells
