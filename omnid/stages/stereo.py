"""Depth of a pair: matching along the columns, then triangulation (Dang et al. 2012, section III)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import StereoConfig
from omnid.core.stereo_matching import Matcher
from omnid.core.triangulation import triangulate
from omnid.messages import Depth, Panoramas
from omnid.stages.geometry import Geometry

Array = NDArray[np.float64]


class Stereo:
    """Locates the edges of the lower panorama."""

    def __init__(self, geometry: Geometry, config: StereoConfig) -> None:
        self._geometry, self._config = geometry, config
        self._T_rig_rect = geometry.T_rig_rect
        self._matcher: Matcher | None = None

    def process(self, panoramas: Panoramas) -> Depth:
        """The disparities, and their points in the rig frame."""
        columns, rows, found = self._match(panoramas)
        disparity = np.full(panoramas.visible.shape, np.nan, np.float32)
        disparity[rows, columns] = found
        views = np.column_stack([columns, rows, rows + found]).astype(float)
        points = triangulate(views, self._geometry.cylinder, self._geometry.rig.baseline_m)
        kept = np.isfinite(points).all(axis=1)
        variance_m2 = self._variance_m2(points[kept])
        points = se3.apply(self._T_rig_rect, points[kept])
        return Depth(panoramas.seq, panoramas.stamp_ns, panoramas, disparity, views[kept, :2], points, variance_m2)

    def _match(self, panoramas: Panoramas) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
        """Columns (N,), rows (N,) and disparities (N,) [px] of the located pixels."""
        lower, pad = panoramas.lower, panoramas.lower.pad_px
        if self._matcher is None:
            self._matcher = Matcher((lower.image.shape[0], lower.image.shape[1]), self._config.matching)
        valid = np.pad(panoramas.visible, ((0, 0), (pad, pad)))
        pixels, disparity = self._matcher.match(lower.image, panoramas.upper.image, valid)
        rows, columns = np.divmod(pixels, lower.image.shape[1])
        return columns - pad, rows, disparity

    def _variance_m2(self, points: Array) -> Array:
        """Variances (N,) along the rays to points (N, 3) in the rectified frame: depth goes with 1 / disparity."""
        r2, z2 = (points[:, :2] ** 2).sum(axis=1), points[:, 2] ** 2
        per_px = r2 / (self._geometry.cylinder.focal_px * self._geometry.rig.baseline_m)
        return np.asarray((1 + z2 / r2) * (per_px * self._config.noise_px) ** 2)
