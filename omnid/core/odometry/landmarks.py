"""New landmarks: corners that are located in both panoramas of a keyframe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import nearby_disparity, pixels_in_upper
from omnid.core.odometry.exposure_times import AssumedMotion, Exposure
from omnid.core.odometry.plane_patches import align_rows, disparity_slopes, fitted_slopes, view_noise
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.odometry.wrong_periods import has_wrong_period
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NewLandmarks:
    """Landmarks that were located in both panoramas of a keyframe."""

    pixels: Array  # (N, 2) px in the lower panorama
    views: Array  # (N, 3) px, at the stamp
    slopes: Array  # (N, 2) px/px of the disparity
    noise: Array  # (N, 3, 3) px^2 of the views, that of the motion left out
    assumed: AssumedMotion  # motion by which the views were corrected


def located(
    frame: StereoFrame, corners: Array, model: StereoModel, klt: KltSettings, exposure: Exposure, known: Array
) -> NewLandmarks:
    """Return the corners (N, 2) of the lower panorama that the upper panorama shows too.

    They are located by SAD (eq. 8), and then by KLT and by their patches to a fraction of a pixel. known (M, 3) [px]:
    views of the map's landmarks.
    """
    # 1. Disparity by dense stereo.
    dense = replace(frame, exposure=exposure).disparity
    guess, spread_px = exposure.upper_pixels(corners, nearby_disparity(dense, corners))
    pair = frame.lower, frame.upper
    # 2. Track into the upper panorama, and align the patch there with the slopes of its surface.
    near = pixels_in_upper(pair, corners, guess, klt, spread_px)
    slopes = disparity_slopes(dense, corners, near[:, 1] - corners[:, 1])
    slopes = fitted_slopes(pair, corners, near, slopes, model)
    rows, variance = align_rows(pair, corners, near, slopes, model)
    found = np.isfinite(rows)
    found[found] = ~has_wrong_period(pair, corners[found], rows[found], known)
    # 3. Correct the views for the motion during the exposures.
    views, _ = exposure.corrected(corners[found], rows[found])
    assumed = AssumedMotion(exposure.motion, exposure.derivatives(views))
    return NewLandmarks(corners[found], views, slopes[found], view_noise(np.zeros((2, 2)), variance[found]), assumed)
