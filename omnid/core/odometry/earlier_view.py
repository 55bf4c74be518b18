"""Dense points that an earlier view of the same camera contradicts.

What is fixed to the rig, such as the reflection of a lens in its mirror, keeps its pixels while the rig moves; both
panoramas of a pair show it, so that they match, at some disparity. In a window of K pixels with unknown gain and
offset, a hypothesis h of where the earlier panorama showed the same surface has the log-likelihood
-K/2 log(1 - rho_h^2), rho_h > 0 the correlation of the windows. The hypotheses are:

1. The point is fixed to the world, at its range: it was seen where the motion predicts it.
2. It is fixed to the rig: it was seen at the same pixel.
3. Neither, with the likelihood of rho = LEAST: also wrong periods of repeated texture, and edges between two surfaces.

A point is contradicted where the first is not the likeliest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder, at_pixels
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.tracking import correlations, padded
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Half the side of the windows, and the least correlation of a point that is confirmed, by trial on development seeds:
# of the right points of clean logs 3.6 % are lost with 0.3, and 6.4 % with 0.5, which finds hardly more wrong ones.
HALF_PX, LEAST = 3, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class EarlierView:
    """The lower panorama of an earlier pair, and the motion since."""

    lower: PaddedPanorama
    usable: Flags  # (H, W) pixels that show the world
    T_earlier_now: Array  # (4, 4) of the rectified frames
    exposure: Exposure | None = None  # motion during its exposures; None: all pixels were exposed at the stamp


def contradicted(
    lower: PaddedPanorama, pixels: Array, points: Array, cylinder: Cylinder, earlier: EarlierView
) -> Flags:
    """Return flags (N,) of points (N, 3) [m] in the rectified frame, found at pixels (N, 2) of the lower panorama.

    A point that the earlier panorama does not show is not contradicted, nor is one without a whole window.
    """
    # 1. Where the earlier panorama showed the points.
    there = se3.apply(earlier.T_earlier_now, points)
    seen = cylinder.pixels(there)
    if earlier.exposure is not None:
        seen -= earlier.exposure.shift(there).px[:, :2]
    chosen, middle = at_pixels(earlier.usable, seen) & cylinder.shows(seen[:, 0]), (cylinder.height - 1) / 2
    for at in (pixels, seen):
        chosen &= np.abs(at[:, 1] - middle) <= middle - HALF_PX
    # 2. The correlations of both hypotheses there; they are one where the point has not moved in the image.
    here, there, images = padded(lower, pixels[chosen]), padded(lower, seen[chosen]), (lower.image, earlier.lower.image)
    of_world, of_rig = correlations(images, here, np.stack([there, here]), 2 * HALF_PX + 1)
    has_moved = np.hypot(lower.wrap(there[:, 0] - here[:, 0]), there[:, 1] - here[:, 1]) > HALF_PX
    wrong = np.zeros(len(points), bool)
    wrong[chosen] = (of_world < LEAST) | (has_moved & (of_rig > of_world))
    return wrong
