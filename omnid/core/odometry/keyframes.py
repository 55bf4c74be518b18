"""Keyframes of the local map: when one is needed, and its new landmarks."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omnid.core.odometry.corners import clear_around, corners, nearby_disparity, pixels_in_upper
from omnid.core.odometry.correlation import has_wrong_period, repeats
from omnid.core.odometry.estimates import OdometryLimits, PoseEstimate
from omnid.core.odometry.exposure_times import AssumedMotion, Exposure
from omnid.core.odometry.local_map import Keyframe, LocalMap, NewLandmarks
from omnid.core.odometry.plane_patches import align_rows, disparity_slopes, fitted_slopes, view_noise
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]

# Share of the landmarks of a first keyframe that match at one disparity only, below which the others are left out:
# rendered rooms with a wall of bricks have 0.42 and more. Left out everywhere, they double the error of the scale.
LEAST_UNIQUE_SHARE = 0.4


class Keyframes:
    """Decides whether the local map needs a keyframe, and adds it."""

    def __init__(
        self,
        local_map: LocalMap,
        model: StereoModel,
        klt: KltSettings,
        limits: OdometryLimits,
        relocaliser: KeyframeLocaliser,
    ) -> None:
        """klt: from the lower panorama to the upper one."""
        self._map, self._model, self._klt, self._limits = local_map, model, klt, limits
        self._relocaliser = relocaliser
        self._most_inliers, self._tracked_s = 0, 0.0  # since the last keyframe

    def is_due(self, inliers: int, dt_s: float) -> bool:
        """True if the local map needs a keyframe at the next accepted frame; inliers: their number there.

        dt_s: since the frame before.
        """
        limits = self._limits
        if limits.keyframes == 1:  # frame to frame: all landmarks are new, the old ones leave with their keyframe
            return True
        self._most_inliers = max(self._most_inliers, inliers)
        self._tracked_s += dt_s
        sparse = inliers < limits.refresh * self._limits.features and self._tracked_s >= limits.sparse_s
        return sparse or inliers < limits.refresh * self._most_inliers or inliers < limits.good_inliers

    def add(
        self,
        frame: StereoFrame,
        usable: NDArray[np.bool_],
        T_odom_rect: Array,
        covariance: Array,
        exposure: Exposure,
        known: PoseEstimate | None = None,
    ) -> None:
        """Add a frame with its pose (4, 4) and covariance (6, 6) as a keyframe, with new landmarks.

        usable (H, W): pixels in which they may lie. known: the estimate whose landmarks stay; None: all are new.
        """
        pixels, views = (np.zeros((0, 2)), np.zeros((0, 3))) if known is None else (known.pixels, known.views)
        points = corners(frame.lower, clear_around(usable, pixels), self._limits.features - len(pixels))
        new = located(frame, points, self._model, self._klt, exposure, views)
        keyframe = Keyframe(frame.seq, frame.lower, T_odom_rect, covariance)
        self._map.add_located(keyframe, new)
        if len(self._map) >= self._limits.min_inliers:
            self._relocaliser.add(replace(frame, exposure=exposure), keyframe)
        self._most_inliers, self._tracked_s = 0, 0.0


def located(
    frame: StereoFrame, points: Array, model: StereoModel, klt: KltSettings, exposure: Exposure, known: Array
) -> NewLandmarks:
    """Return the corners (N, 2) of the lower panorama that the upper panorama shows too.

    They are located by SAD (eq. 8), and then by KLT and by their patches to a fraction of a pixel. known (M, 3) [px]:
    views of the map's landmarks.
    """
    # 1. Disparity by dense stereo.
    dense = replace(frame, exposure=exposure).disparity
    guess, spread_px = exposure.upper_pixels(points, nearby_disparity(dense, points))
    pair = frame.lower, frame.upper
    # 2. Track into the upper panorama, and align the patch there with the slopes of its surface.
    near = pixels_in_upper(pair, points, guess, klt, spread_px)
    slopes = disparity_slopes(dense, points, near[:, 1] - points[:, 1])
    slopes = fitted_slopes(pair, points, near, slopes, model)
    rows, variance = align_rows(pair, points, near, slopes, model)
    found = np.isfinite(rows)
    if len(known):
        found[found] = ~has_wrong_period(pair, points[found], rows[found], known)
    elif found.any():
        unique = ~repeats(pair, points[found], rows[found], round(model.cylinder.focal_px))
        if unique.mean() < LEAST_UNIQUE_SHARE:
            found[found] = unique
    # 3. Correct the views for the motion during the exposures.
    views, _ = exposure.corrected(points[found], rows[found])
    assumed = AssumedMotion(exposure.motion, exposure.derivatives(views))
    return NewLandmarks(points[found], views, slopes[found], view_noise(np.zeros((2, 2)), variance[found]), assumed)


class KeyframeLocaliser(Protocol):
    """A bounded store of keyframes that gives the pose of a frame among them; see core/places."""

    def add(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keep a keyframe and its frame."""

    def clear(self) -> None:
        """Drop all keyframes."""

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """Return the pose of a frame among the keyframes; None if it fits none."""
