"""Dense depth of a pair by vertical stereo, and the memory of it, which several stages share."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import StereoConfig
from omnid.core.odometry.earlier_view import EarlierView, contradicted
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.stereo.matcher import Matcher
from omnid.core.stereo.triangulation import triangulate
from omnid.core.types.panorama import PaddedPanorama, Panoramas
from omnid.engine.threads import Lock
from omnid.errors import OmnidError
from omnid.messages import DensePoints, StereoDepth
from omnid.stages.geometry import Geometry

Array = NDArray[np.float64]

DISPARITY_STEP_PX = 32  # the semi-global prior searches a multiple of it


class DenseDepths:
    """Dense depths, computed when they are first asked for.

    Matching costs as much as the odometry of a pair, and few pairs need it: keyframes, and those that enter the map or
    the obstacle scan. What was computed is remembered as long as the panoramas of the pair exist. Any thread may ask;
    while one computes, others that ask for the same pair wait for the result.
    """

    def __init__(self, geometry: Geometry, config: StereoConfig) -> None:
        self._config, self._cylinder, self._baseline_m = config, geometry.cylinder, geometry.rig.baseline_m
        self._T_rig_rect = geometry.T_rig_rect
        # Disparities up to those of the nearest points; rows are left beyond the largest one.
        height, step_px = geometry.cylinder.height, DISPARITY_STEP_PX
        limit = (height - step_px // 2) // step_px * step_px
        if limit < step_px:
            raise OmnidError(
                f"the panoramas are {height} px high, stereo needs at least {step_px + step_px // 2} px: use "
                "larger images, or a rig whose cameras share more of their view"
            )
        nearest_px = self._cylinder.focal_px * self._baseline_m / config.min_range_m
        disparities = min(config.matching.disparities, math.ceil(nearest_px / step_px) * step_px, limit)
        self._matching = replace(config.matching, disparities=disparities)
        self._idle: deque[Matcher] = deque()  # matchers with their buffers: one for each thread that matched at once
        self._known: WeakKeyDictionary[Panoramas, tuple[dict[object, DensePoints], Lock]] = WeakKeyDictionary()
        self._one = Lock()

    def of(self, depth: StereoDepth) -> DensePoints:
        """Return the dense depth of a pair whose pose is known: points that its earlier view does not contradict."""
        dense, earlier = self.points(depth.panoramas, depth.exposure), depth.earlier
        if earlier is None:
            return dense
        compute = partial(self._confirmed, depth.panoramas.lower, dense, earlier)
        return self._once(depth.panoramas, (depth.exposure, earlier), compute)

    def points(self, panoramas: Panoramas, exposure: Exposure | None = None) -> DensePoints:
        """Return disparities and their points in the rig frame, as matched, at the stamp of the pair.

        exposure: the motion during the exposures; None: unknown, or none is needed.
        """
        return self._once(panoramas, exposure, partial(self._computed, panoramas, exposure))

    def _once(self, panoramas: Panoramas, key: object, compute: Callable[[], DensePoints]) -> DensePoints:
        """Return what was computed of a pair, by what it depends on; others wait meanwhile."""
        with self._one:
            known, one = self._known.setdefault(panoramas, ({}, Lock()))
        with one:
            if key not in known:
                known[key] = compute()
            return known[key]

    def _computed(self, panoramas: Panoramas, exposure: Exposure | None) -> DensePoints:
        """Return the depth of panoramas, corrected for a motion during their exposures."""
        # 1. Match the pixels of the lower panorama along their columns.
        lower, pad = panoramas.lower, panoramas.lower.pad_px
        valid = np.pad(panoramas.usable, ((0, 0), (pad, pad)))
        shift = None if exposure is None else exposure.column_shift(panoramas.visible.shape, pad)
        try:
            matcher = self._idle.pop()
        except IndexError:
            matcher = Matcher(lower.image.shape[:2], self._matching)
        flat, found = matcher.match(lower.image, panoramas.upper.image, valid, lower.noise_grey, shift)
        self._idle.append(matcher)
        rows, columns = np.divmod(flat, lower.image.shape[1])
        columns -= pad
        # 2. Correct rows and disparities to the stamp of the pair.
        views, by_motion = np.column_stack([columns, rows, rows + found]).astype(float), np.zeros(len(found))
        if exposure is not None:
            views, of_motion = exposure.corrected(views[:, :2], views[:, 2])
            noise = of_motion.noise(exposure.motion)
            by_motion = noise[:, 1, 1] + noise[:, 2, 2] - 2 * noise[:, 1, 2]
        disparity = np.full(panoramas.visible.shape, np.nan, np.float32)
        disparity[rows, columns] = views[:, 2] - views[:, 1]
        # 3. Triangulate, with the variance along the ray: the distance from the axis is r = f t / d, so sigma_r is
        #    r^2 / (f t) sigma_d, and sqrt(1 + z^2 / r^2) times as large along the ray.
        points = triangulate(views, self._cylinder, self._baseline_m)
        kept = np.isfinite(points).all(axis=1)
        points = points[kept]
        r2, z2 = (points[:, :2] ** 2).sum(axis=1), points[:, 2] ** 2
        per_px = r2 / (self._cylinder.focal_px * self._baseline_m)
        variance_m2 = (1 + z2 / r2) * per_px**2 * (self._config.noise_px**2 + by_motion[kept])
        pixels = np.column_stack([columns, rows])[kept].astype(float)
        return DensePoints(disparity, pixels, se3.apply(self._T_rig_rect, points), variance_m2)

    def _confirmed(self, lower: PaddedPanorama, dense: DensePoints, earlier: EarlierView) -> DensePoints:
        """Return the dense points of a pair without those that its earlier view contradicts."""
        points = se3.apply(se3.inverse(self._T_rig_rect), dense.points)
        wrong = contradicted(lower, dense.pixels, points, self._cylinder, earlier)
        disparity = dense.disparity.copy()
        columns, rows = dense.pixels[wrong].astype(np.intp).T
        disparity[rows, columns] = np.nan
        return DensePoints(disparity, dense.pixels[~wrong], dense.points[~wrong], dense.variance_m2[~wrong])
