"""Patches of a plane, as another view shows them: exact, where `patch_alignment` has an affine map.

A wall seen aslant is stretched more on its near side than on its far side, and that changes from view to view. Over a
window of 13 px the quadratic part shifts a patch by some hundredths of a pixel, in the same direction for a whole wall.
A pose averages over many walls; a rig is calibrated to better than that.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.patch_alignment import Image, affine_warps
from omnid.core.odometry.patch_fit import TEMPLATE_PX
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import PaddedPanorama
from omnid.core.stereo.triangulation import triangulate, view

Array = NDArray[np.float64]

STEPS = 2  # of the inversion: each reduces the error by the change of the map over the patch, about a tenth
MAX_ERROR_PX = 3.0  # of the affine map within a patch; where it errs more, the plane is no description


def plane_templates(keyframe: PaddedPanorama, planes: tuple[Array, Array], T_curr_ref: Array, model: StereoModel,
                    near: Array, *, upper: bool) -> Image:
    """Return templates (N, TEMPLATE, TEMPLATE) of a keyframe's patches for pixels near (N, 2) in the current panorama.

    planes: views (N, 3) and slopes (N, 2) of the disparity in the keyframe, T_curr_ref (N, 4, 4) from it. upper: the
    current panorama is the upper one. The templates' pixels are whole pixels of the current panorama.
    """
    views, slopes = planes
    back = np.linalg.inv(affine_warps(views, slopes, T_curr_ref, model, upper=upper))
    side = np.arange(TEMPLATE_PX) - TEMPLATE_PX // 2
    grid = np.stack([np.tile(side, TEMPLATE_PX), np.repeat(side, TEMPLATE_PX)], axis=1)
    wanted = grid + (np.rint(near) - near)[:, None]
    source = wanted @ np.swapaxes(back, 1, 2)
    for _ in range(STEPS):
        error = wanted - _moved(source, planes, T_curr_ref, model, upper=upper)
        fits = np.asarray((np.abs(error) < MAX_ERROR_PX).all(axis=(1, 2)))
        source = np.where(fits[:, None, None], source + error @ np.swapaxes(back, 1, 2), source)
    columns = views[:, :1] % keyframe.width + keyframe.pad_px + source[:, :, 0]
    rows = views[:, 1:2] + source[:, :, 1]
    patches = cv2.remap(keyframe.image, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR,
                        borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(patches, np.uint8).reshape(-1, TEMPLATE_PX, TEMPLATE_PX)


def _moved(offsets: Array, planes: tuple[Array, Array], T_curr_ref: Array, model: StereoModel, *, upper: bool) -> Array:
    """Return the offsets (N, K, 2) in the current panorama of offsets (N, K, 2) from the centres in the keyframe.

    On a plane 1 / r, and with it the disparity, is linear in the slope z / r and a sine wave over the azimuth.
    """
    views, slopes = planes
    count, size = offsets.shape[:2]
    centred = np.concatenate([np.zeros((count, 1, 2)), offsets], axis=1)
    there = views[:, None] + centred[:, :, [0, 1, 1]]
    by_row = slopes[:, 1:] * (views[:, 1:2] - model.cylinder.row0)
    upright = views[:, 2:] - views[:, 1:2] - by_row
    turn = centred[..., 0] / model.cylinder.focal_px
    wave = upright * np.cos(turn) + slopes[:, :1] * model.cylinder.focal_px * np.sin(turn)
    there[..., 2] = there[..., 1] + wave + by_row + slopes[:, 1:] * centred[..., 1]
    points = triangulate(there.reshape(-1, 3), model.cylinder, model.baseline_m).reshape(count, size + 1, 3)
    seen = view(se3.apply(T_curr_ref, points).reshape(-1, 3), model.cylinder, model.baseline_m)
    pixels = seen[:, [0, 2] if upper else [0, 1]].reshape(count, size + 1, 2)
    moved = pixels[:, 1:] - pixels[:, :1]
    moved[..., 0] = model.cylinder.wrap(moved[..., 0])
    return np.asarray(moved)
