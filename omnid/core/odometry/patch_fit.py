"""Shift, gain and offset between patches of two images by least squares, with the covariance of the shift.

The exposure of a camera may change from image to image and differs between two cameras, and vignetting changes the
brightness of a point that moves across the image. So each patch has a gain and an offset of its own: with template t,
its gradient g, and the current patch c, c(x + d) = a t(x) + b is solved for d, a and b by Gauss-Newton with the
template's gradient (Lucas and Kanade 1981; gain and offset as in Jin, Favaro, Soatto 2001). All about the means of
template and window, which takes the offset out:

    H = sum of m m^T, m = (-g_x, -g_y, t);   H (a d_x, a d_y, a) = sum of m c

The gain has a prior: the median over its image of the ratio of the contrasts. A regression would be too low, because
the template has noise; the ratio of contrasts holds that of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry import patch_kernels

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
