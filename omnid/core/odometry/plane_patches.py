"""Patches of planes, as another view shows them: the exact map, in closed form, and the slopes of the planes.

A wall seen aslant is stretched more on its near side than on its far side, and that changes from view to view. Over a
window of 13 px the quadratic part of the map shifts a patch by some hundredths of a pixel, in the same direction for a
whole wall, so that no number of landmarks averages it out: an affine map is not enough.

A plane n . p = 1 is seen from a motion p' = R p + t as n' . p' = 1 + n' . t with n' = R n. A ray u' from the origin o'
meets it at the scale (1 + n' . t - n' . o') / (n' . u'), so that the point in the first frame is in the direction of
R^T ((1 + n' . t - n' . o') u' + (o' - t) (n' . u')): a linear map of u', the homography of the plane (Hartley and
Zisserman 2004, 13.1), here between cylinders.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry import patch_kernels, plane_kernels, slope_kernels
from omnid.core.odometry.patch_kernels import cut
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

WINDOW_PX = patch_kernels.WINDOW_PX
TEMPLATE_PX = WINDOW_PX + 2  # holds the window and the border that the gradient's 3x3 operator needs


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
    count = len(templates)
    found = PatchFit(np.empty((count, 2)), np.empty((count, 2, 2)), np.empty(count, bool))
    patch_kernels.fit(
        np.ascontiguousarray(templates),
        np.ascontiguousarray(cells),
        groups,
        noise_grey,
        found.shift,
        found.covariance,
        found.fits,
    )
    return found


Floats = NDArray[np.float32]

# Half the side of the window in which the slope of the dense disparity is taken.
SLOPE_REACH_PX = 8
# Disparities that differ more belong to another surface.
SAME_SURFACE_PX = 2.0
# px^2, weight of slope zero (an upright surface facing the camera) in the least squares: a full window has 6936
# px^2, so that the slope is 0.7 % too flat.
SLOPE_PRIOR = 50.0
MIN_NOISE_GREY = 1.0  # Least noise of images: rounding, and errors of the model.


def plane_templates(
    images: Mapping[int, PaddedPanorama],
    anchors: Indices,
    pixels: Array,
    surfaces: tuple[Array, Array],
    T_curr_ref: Array,
    model: StereoModel,
    predicted: Array,
    *,
    upper: bool = False,
) -> Image:
    """Return templates (N, TEMPLATE, TEMPLATE) of patches at pixels (N, 2) of images, as the current view shows them.

    anchors (N,): the key of the image of each, one of the images. surfaces: points (N, 3) [m] at the patches' centres
    and slopes (N, 2) of the disparity there, both in the rectified frames of the images; T_curr_ref (N, 4, 4) from
    these. upper: the current panorama is the upper one. The templates' pixels are whole pixels of the current panorama,
    which shows the centres at predicted (N, 2). Where a plane is seen edge on, the patch is not bent. KeyError for an
    anchor without an image.
    """
    templates = np.empty((len(pixels), TEMPLATE_PX, TEMPLATE_PX), np.uint8)
    points, slopes = (np.ascontiguousarray(part) for part in surfaces)
    T_curr_ref, shift = np.ascontiguousarray(T_curr_ref), np.ascontiguousarray(np.rint(predicted) - predicted)
    height_m = model.baseline_m if upper else 0.0
    # All panoramas of a run have the same columns.
    centres = _padded(next(iter(images.values())), pixels) if images else pixels
    rows = {key: np.flatnonzero(anchors == key) for key in images}
    if sum(map(len, rows.values())) != len(anchors):
        raise KeyError(f"anchors {set(anchors.tolist()) - set(images)} have no image")
    for key, chosen in rows.items():
        plane_kernels.sample(
            images[key].image,
            chosen,
            centres,
            points,
            slopes,
            T_curr_ref,
            model.baseline_m,
            height_m,
            model.cylinder.focal_px,
            shift,
            templates,
        )
    return templates


def moved_slopes(surfaces: tuple[Array, Array], T_curr_ref: Array, model: StereoModel) -> Array:
    """Return the slopes (N, 2) of the disparity in the frames to which T_curr_ref (N, 4, 4) leads.

    surfaces: points (N, 3) and slopes (N, 2). Zero where the plane is seen nearly edge on.
    """
    points, slopes = (np.ascontiguousarray(part) for part in surfaces)
    moved = np.empty((len(points), 2))
    plane_kernels.move_slopes(points, slopes, np.ascontiguousarray(T_curr_ref), model.baseline_m, moved)
    return moved


def disparity_slopes(disparity: Floats, points: Array, centre: Array) -> Array:
    """Return slopes (N, 2) of the disparity [px/px] along column and row at points (N, 2) with disparity centre (N,).

    A plane through the centre by regularised least squares; neighbours that differ by more than SAME_SURFACE_PX are
    left out, and all where the centre is NaN. Dense stereo matches upright windows, so these slopes are too flat.
    """
    height, width = disparity.shape
    offsets = np.arange(-SLOPE_REACH_PX, SLOPE_REACH_PX + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offsets, offsets))
    columns = (np.rint(points[:, :1]).astype(int) + dx) % width
    rows = np.clip(np.rint(points[:, 1:]).astype(int) + dy, 0, height - 1)
    change = disparity[rows, columns] - centre[:, None]
    near = np.abs(change) < SAME_SURFACE_PX
    change = np.where(near, change, 0.0)
    xx, yy, xy = near @ (dx * dx) + SLOPE_PRIOR, near @ (dy * dy) + SLOPE_PRIOR, near @ (dx * dy)
    x, y = change @ dx, change @ dy
    return np.asarray(np.column_stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy**2)[:, None])


def fitted_slopes(
    pair: tuple[PaddedPanorama, PaddedPanorama], pixels: Array, near: Array, start: Array, model: StereoModel
) -> Array:
    """Return slopes (N, 2) of the disparity at pixels (N, 2) of the lower panorama, seen near (N, 2) in the upper one.

    start (N, 2): first values, which stay where near is NaN or the fit fails. A plane makes the upper window a bent
    lower one: its shift, its two slopes, gain and offset are fitted to both windows together, by Gauss-Newton with the
    lower one's gradient as in `patch_fit`. The start is a weak prior. Dense slopes are a third too flat and scatter by
    0.05; a landmark's patch, seen from elsewhere, would be shifted by tenths of a pixel.
    """
    known = np.flatnonzero(np.isfinite(near).all(axis=1))
    lower, upper = pair
    slopes, found = start.copy(), np.empty((len(known), 2))
    heights = (model.cylinder.row0 - pixels[known, 1]) / model.cylinder.focal_px
    noise_grey = max(lower.noise_grey, MIN_NOISE_GREY)
    slope_kernels.fit(
        lower.image,
        upper.image,
        _padded(lower, pixels[known]),
        _padded(upper, near[known]),
        np.ascontiguousarray(start[known]),
        heights,
        model.cylinder.focal_px,
        noise_grey,
        found,
    )
    slopes[known] = found
    return slopes


def _padded(panorama: PaddedPanorama, pixels: Array) -> Array:
    """Return pixels (N, 2) of the padded image."""
    return np.column_stack([panorama.padded(pixels[:, 0]), pixels[:, 1]])


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
