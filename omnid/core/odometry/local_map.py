"""Local map: prediction, tracking and alignment of the landmarks near the robot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.landmarks import Keyframe, LandmarkStore
from omnid.core.odometry.patch_alignment import AlignedPatches, affine_warps, align, warped_templates
from omnid.core.odometry.patch_fit import TEMPLATE_PX
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama, track
from omnid.core.stereo.triangulation import view

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

COARSE_ITERATIONS = 8  # of Lucas-Kanade on each level: the patches are aligned afterwards
BACK_LEVELS = 1  # of the track back from a prediction: RANSAC rejects what it lets pass
EDGE_ROWS = 3  # px: a landmark predicted nearer to the panorama's upper or lower edge is not tracked


@dataclass(frozen=True, slots=True)
class Tracks:
    """Landmarks that were tracked into a new panorama."""

    landmarks: Indices  # (M,) rows of the table of landmarks
    pixels: Array  # (M, 2) px where they were found
    predicted: Array  # (M, 3) px: views that the guessed pose predicts
    visible: int  # landmarks that were predicted within the panorama


class LocalMap:
    """Landmarks in a store, and the last panorama in which they were found."""

    def __init__(self, model: StereoModel, klt: KltSettings, max_keyframes: int = 8, max_misses: int = 3) -> None:
        self._model, self._klt = model, klt
        self._coarse_klt = replace(klt, iterations=min(klt.iterations, COARSE_ITERATIONS))
        self.store = LandmarkStore(model, max_keyframes, max_misses)
        self._last: PaddedPanorama | None = None

    def __len__(self) -> int:
        return len(self.store)

    def clear(self) -> None:
        """Remove all landmarks and keyframes."""
        self.store.clear()
        self._last = None

    def add_keyframe(self, keyframe: Keyframe, views: Array, slopes: Array, noise: Array | None = None,
                     pixels: Array | None = None) -> None:
        """Add a keyframe at the last panorama with new landmarks: see LandmarkStore.add_keyframe."""
        self.store.add_keyframe(keyframe, views, slopes, noise, pixels)
        self._last = keyframe.lower

    def update_tracked(self, lower: PaddedPanorama, landmarks: Indices, pixels: Array) -> None:
        """Record the inliers (rows of the table) of an accepted panorama with their pixels (M, 2)."""
        self.store.update_tracked(landmarks, pixels)
        self._last = lower

    def track(self, lower: PaddedPanorama, T_odom_rect: Array, most: int | None = None) -> Tracks:
        """Track the landmarks of the last panorama into a new one, from the pixels that a guessed pose predicts.

        most: track only about so many, evenly chosen, to compare guesses cheaply.
        """
        rows, predicted = self.visible(T_odom_rect)
        known = np.isfinite(self.store.table.pixels[rows, 0])
        rows, predicted = rows[known], predicted[known]
        if most is not None:
            every = max(1, -(-len(rows) // most))
            rows, predicted = rows[::every], predicted[::every]
        if self._last is None:
            return Tracks(rows[:0], np.zeros((0, 2)), predicted[:0], 0)
        back_levels = BACK_LEVELS if most is None else self._klt.levels
        before = self.store.table.pixels[rows]
        pixels, found = track(self._last, lower, before, predicted[:, :2], self._coarse_klt, back_levels)
        return Tracks(rows[found], pixels[found], predicted[found], len(rows))

    def visible(self, T_odom_rect: Array) -> tuple[Indices, Array]:
        """Return the landmarks (M,) that a pose predicts within the panorama, and their views (M, 3) [px]."""
        points = se3.apply(se3.inverse(T_odom_rect), self.store.table.points)
        predicted = view(points, self._model.cylinder, self._model.baseline_m)
        bottom = self._model.cylinder.height - 1 - EDGE_ROWS
        rows = np.flatnonzero((predicted[:, 1] > EDGE_ROWS) & (predicted[:, 1] < bottom))
        return rows, predicted[rows]

    def align(self, lower: PaddedPanorama, T_odom_rect: Array, landmarks: Indices,
              shift: Array | float = 0.0) -> AlignedPatches:
        """Align the keyframes' patches of landmarks (M,) with a panorama whose pose is known well.

        A patch is found where it has texture and moved little from its prediction. shift: see ViewShift.lower.
        """
        table, keyframes = self.store.table, self.store.keyframes
        T_rect_odom = se3.inverse(T_odom_rect)
        points = se3.apply(T_rect_odom, table.points[landmarks])
        predicted = view(points, self._model.cylinder, self._model.baseline_m)[:, :2] - shift
        anchors = table.anchor[landmarks]
        T_curr_ref = np.array([T_rect_odom @ keyframes[seq].T_odom_rect for seq in anchors.tolist()])
        warps = affine_warps(
            table.views[landmarks], table.slopes[landmarks], T_curr_ref.reshape(-1, 4, 4), self._model
        )
        templates = np.zeros((len(landmarks), TEMPLATE_PX, TEMPLATE_PX), np.uint8)
        for seq in np.unique(anchors).tolist():
            own = np.flatnonzero(anchors == seq)
            pixels = table.anchor_pixels[landmarks[own]]
            templates[own] = warped_templates(keyframes[seq].lower, pixels, warps[own], predicted[own])
        return align(templates, lower, predicted, anchors)
