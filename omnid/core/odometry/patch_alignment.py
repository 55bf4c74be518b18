"""Alignment of landmarks' patches, warped to the new viewpoint, to hundredths of a pixel.

Plain Lucas-Kanade shifts a window but does not warp it, and errs by tenths of a pixel as soon as the camera has moved
some decimetres. Here each keyframe patch is warped by the affine map that pose, depth and local slope predict, and
`patch_fit` finds the remaining shift together with a gain and an offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.patch_fit import TEMPLATE_PX, WINDOW_PX, PatchFit, fit_patches
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.core.stereo.triangulation import triangulate, view

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
Indices = NDArray[np.intp]

HALF_BASE_PX = 4.0  # half the base of the difference quotients that give the warp
REACH_PX = 1  # of patches whose pose and depth are known well
CROSS_PX = 0.5  # by which a patch may move sideways in the upper panorama from where it was tracked to
MAX_STRETCH, MIN_AREA = 2.0, 0.25  # of a warp: largest element and smallest determinant
SLOPE_REACH_PX = 8  # half the side of the window in which the slope of the disparity is measured
SAME_SURFACE_PX = 2.0  # disparities that differ more belong to another surface
SLOPE_PRIOR = 50.0  # px^2, weight of slope zero (an upright surface facing the camera) in the least squares


def disparity_slopes(disparity: Floats, points: Array, centre: Array, reach_px: int = SLOPE_REACH_PX) -> Array:
    """Return slopes (N, 2) of the disparity [px/px] along column and row at points (N, 2) with disparity centre (N,).

    A plane through the centre by regularised least squares; neighbours that differ by more than SAME_SURFACE_PX are
    left out.
    """
    height, width = disparity.shape
    offsets = np.arange(-reach_px, reach_px + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(offsets, offsets))
    columns = (np.rint(points[:, :1]).astype(int) + dx) % width
    rows = np.clip(np.rint(points[:, 1:]).astype(int) + dy, 0, height - 1)
    change = disparity[rows, columns] - centre[:, None]
    near = np.abs(change) < SAME_SURFACE_PX
    change = np.where(near, change, 0.0)
    xx, yy, xy = near @ (dx * dx) + SLOPE_PRIOR, near @ (dy * dy) + SLOPE_PRIOR, near @ (dx * dy)
    x, y = change @ dx, change @ dy
    return np.asarray(np.column_stack([yy * x - xy * y, xx * y - xy * x]) / (xx * yy - xy**2)[:, None])


def affine_warps(views: Array, slopes: Array, T_curr_ref: Array, model: StereoModel, *, upper: bool = False) -> Array:
    """Return matrices (N, 2, 2): pixels moved in the current panorama per pixel moved in the keyframe's.

    views (N, 3) and slopes (N, 2) in the keyframes, T_curr_ref (N, 4, 4) from them. The identity replaces a warp that
    stretches or shrinks too much.
    """
    steps = HALF_BASE_PX * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])  # (column, row)
    moved = views[:, None] + steps[:, [0, 1, 1]]
    moved[..., 2] += slopes @ steps.T
    points = triangulate(moved.reshape(-1, 3), model.cylinder, model.baseline_m).reshape(-1, 4, 3)
    seen = view(se3.apply(T_curr_ref, points).reshape(-1, 3), model.cylinder, model.baseline_m)
    ends = seen[:, [0, 2] if upper else [0, 1]].reshape(-1, 4, 2)
    difference = ends[:, 0::2] - ends[:, 1::2]
    difference[..., 0] = model.cylinder.wrap(difference[..., 0])
    warps = np.swapaxes(difference, 1, 2) / (2 * HALF_BASE_PX)
    area = np.abs(warps[:, 0, 0] * warps[:, 1, 1] - warps[:, 0, 1] * warps[:, 1, 0])
    sane = (np.abs(warps) < MAX_STRETCH).all(axis=(1, 2)) & (area > MIN_AREA)  # false for NaN as well
    return np.where(sane[:, None, None], warps, np.eye(2))


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


def align(templates: Image, current: PaddedPanorama, predicted: Array, groups: Indices, reach_px: int = REACH_PX
          ) -> AlignedPatches:
    """Align templates (N, TEMPLATE, TEMPLATE), centred on predicted (N, 2), with the current panorama.

    groups (N,): patches that come from one image have one number. reach_px: a patch that has to move so far was
    predicted wrongly.
    """
    cells = _cut(current, np.rint(predicted), WINDOW_PX + 2 * reach_px)
    return AlignedPatches.of(fit_patches(templates, cells, groups, current.noise_grey), predicted)


def align_rows(pair: tuple[PaddedPanorama, PaddedPanorama], points: Array, near: Array) -> tuple[Array, Array]:
    """Align patches of the lower panorama at points (N, 2) with the upper one near pixels (N, 2), NaN where unknown.

    Returns the rows (N,), NaN where no patch fits, and their variances (N,) [px^2] by the noise. Gain and offset of
    the two cameras may differ.
    """
    known = np.flatnonzero(np.isfinite(near).all(axis=1))
    predicted = near[known]
    upright = np.broadcast_to(np.eye(2), (len(known), 2, 2))
    one = np.zeros(len(known), np.intp)
    templates = warped_templates(pair[0], points[known], upright, predicted)
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


def warped_templates(keyframe: PaddedPanorama, pixels: Array, warps: Array, predicted: Array) -> Image:
    """Return templates (N, TEMPLATE, TEMPLATE) of a keyframe around pixels (N, 2), warped, for predicted (N, 2).

    They are sampled so that their pixels are whole pixels of the panorama in which they are predicted.
    """
    return templates_of({0: keyframe}, np.zeros(len(pixels), np.intp), pixels, warps, predicted)


def templates_of(images: Mapping[int, PaddedPanorama], anchors: Indices, pixels: Array, warps: Array, predicted: Array
                 ) -> Image:
    """Return `warped_templates` of several images of one size; anchors (N,): the key of the image of each."""
    templates = np.empty((len(pixels), TEMPLATE_PX**2), np.uint8)
    if not len(pixels):
        return templates.reshape(-1, TEMPLATE_PX, TEMPLATE_PX)
    order = np.argsort(anchors, kind="stable")
    size = next(iter(images.values()))
    back = np.linalg.inv(warps).astype(np.float32)
    centre = (back @ (np.rint(predicted) - predicted).astype(np.float32)[:, :, None])[:, :, 0]
    centre += np.column_stack([pixels[:, 0] % size.width + size.pad_px, pixels[:, 1]]).astype(np.float32)
    back, centre = back[order], centre[order]
    side = np.arange(TEMPLATE_PX, dtype=np.float32) - TEMPLATE_PX // 2
    columns, rows = (
        ((centre[:, axis, None] + back[:, axis, 1, None] * side)[:, :, None] + (back[:, axis, 0, None] * side)[:, None]
         ).reshape(templates.shape) for axis in (0, 1)
    )
    keys, first = np.unique(anchors[order], return_index=True)
    for key, start, end in zip(keys.tolist(), first, [*first[1:], len(order)], strict=True):
        templates[order[start:end]] = cv2.remap(images[key].image, columns[start:end], rows[start:end],
                                                cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return templates.reshape(-1, TEMPLATE_PX, TEMPLATE_PX)


def _cut(panorama: PaddedPanorama, centres: Array, side_px: int) -> Image:
    """Return cells (N, side, side) around whole pixels (N, 2), also across the seam; the border is repeated."""
    image, side = panorama.image, np.arange(side_px) - side_px // 2
    columns = (centres[:, :1] % panorama.width).astype(np.intp) + panorama.pad_px + side
    rows = centres[:, 1:].astype(np.intp) + side
    columns = columns.clip(0, image.shape[1] - 1)
    rows = rows.clip(0, image.shape[0] - 1) * image.shape[1]
    return np.asarray(np.take(image.reshape(-1), rows[:, :, None] + columns[:, None]))
