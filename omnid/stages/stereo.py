"""Depth of a pair: matching along the columns, then triangulation (Dang et al. 2012, section III)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import StereoConfig
from omnid.core.stereo.matcher import Matcher, MatchingSettings
from omnid.core.stereo.triangulation import triangulate
from omnid.errors import OmnidError
from omnid.messages import Panoramas, StereoDepth
from omnid.stages.geometry import Geometry

Array = NDArray[np.float64]

PAIRS_COMPARED, POINTS_TO_COMPARE = 2, 200
STEP_PX, SPARE_ROWS = 32, 16  # the semi-global prior searches in such steps, and wants rows to spare


class Stereo:
    """Locates the edges of the lower panorama."""

    def __init__(self, geometry: Geometry, config: StereoConfig) -> None:
        self._geometry, self._config = geometry, config
        self._T_rig_rect = geometry.T_rig_rect
        self._matcher: Matcher | None = None
        self._compared = self._points = self._exchanged_points = 0

    @property
    def exchanged(self) -> bool:
        """Whether more points of the first pairs match when the upper image is taken for the lower one.

        With a disparity of the wrong sign there is no true match, but walls that repeat themselves give false ones:
        on rendered rooms 0.1 to 0.8 times as many the right way round, 1.1 to 3.6 times as many the wrong way.
        """
        return self._exchanged_points > max(POINTS_TO_COMPARE, self._points)

    def process(self, panoramas: Panoramas) -> StereoDepth:
        """The disparities, and their points in the rig frame."""
        columns, rows, found = self._match(panoramas)
        if self._compared < PAIRS_COMPARED:
            self._compare(panoramas, len(found))
        disparity = np.full(panoramas.visible.shape, np.nan, np.float32)
        disparity[rows, columns] = found
        views = np.column_stack([columns, rows, rows + found]).astype(float)
        points = triangulate(views, self._geometry.cylinder, self._geometry.rig.baseline_m)
        kept = np.isfinite(points).all(axis=1)
        variance_m2 = self._variance_m2(points[kept])
        points = se3.apply(self._T_rig_rect, points[kept])
        return StereoDepth(
            panoramas.seq, panoramas.stamp_ns, panoramas, disparity, views[kept, :2], points, variance_m2
        )

    def _match(self, panoramas: Panoramas) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
        """Columns (N,), rows (N,) and disparities (N,) [px] of the located pixels."""
        lower, pad = panoramas.lower, panoramas.lower.pad_px
        if self._matcher is None:
            self._matcher = Matcher(lower.image.shape[:2], self._fitting(lower.image.shape[0]))
        valid = np.pad(panoramas.visible, ((0, 0), (pad, pad)))
        pixels, disparity = self._matcher.match(lower.image, panoramas.upper.image, valid)
        rows, columns = np.divmod(pixels, lower.image.shape[1])
        return columns - pad, rows, disparity

    def _compare(self, panoramas: Panoramas, points: int) -> None:
        self._compared += 1
        self._points += points
        self._exchanged_points += len(self._match(replace(panoramas, lower=panoramas.upper, upper=panoramas.lower))[0])

    def _variance_m2(self, points: Array) -> Array:
        """Variances (N,) along the rays to points (N, 3) in the rectified frame: depth goes with 1 / disparity."""
        r2, z2 = (points[:, :2] ** 2).sum(axis=1), points[:, 2] ** 2
        per_px = r2 / (self._geometry.cylinder.focal_px * self._geometry.rig.baseline_m)
        return np.asarray((1 + z2 / r2) * (per_px * self._config.noise_px) ** 2)


    def _fitting(self, height: int) -> MatchingSettings:
        """The matching whose disparities reach the nearest points wanted, in panoramas of so many rows."""
        nearest_px = self._geometry.cylinder.focal_px * self._geometry.rig.baseline_m / self._config.min_range_m
        wanted = math.ceil(nearest_px / STEP_PX) * STEP_PX
        matching = self._config.matching
        return _limited(replace(matching, disparities=min(matching.disparities, wanted)), height)


def _limited(matching: MatchingSettings, height: int) -> MatchingSettings:
    """The matching for panoramas of so many rows: a larger disparity than they are high cannot be."""
    most = (height - SPARE_ROWS) // STEP_PX * STEP_PX
    if most < STEP_PX:
        raise OmnidError(
            f"the panoramas are only {height} px high, {STEP_PX + SPARE_ROWS} px are needed for stereo: larger "
            "images, or a rig whose cameras share more of their view"
        )
    return replace(matching, disparities=min(matching.disparities, most))
