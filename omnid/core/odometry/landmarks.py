"""A small map of landmarks about the robot, each anchored in the keyframe that saw it first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.patch_alignment import CELL_PX, affine_warps, align, warped_templates
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama, track
from omnid.core.stereo.triangulation import point_covariance, triangulate, view

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

EDGE_ROWS = 3  # a landmark predicted nearer than this to the panorama's upper or lower edge is not looked for


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A panorama that landmarks are anchored in; T_odom_rect places its rectified frame, covariance (6, 6) in it."""

    seq: int
    lower: PaddedPanorama
    T_odom_rect: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Tracks:
    """Landmarks found in a new panorama: their indices (M,), pixels (M, 2), predicted views (M, 3); how many to see."""

    index: Indices
    pixels: Array
    predicted: Array
    visible: int


class LocalMap:
    """Landmarks (N) with position in odom, covariance, keyframe and pixel there; bounded by the keyframes kept."""

    def __init__(self, model: StereoModel, klt: KltSettings, max_keyframes: int = 5, max_misses: int = 3) -> None:
        self._model, self._klt = model, klt
        self._max_keyframes, self._max_misses = max_keyframes, max_misses
        self.clear()

    def clear(self) -> None:
        """Forgets everything."""
        self.keyframes: dict[int, Keyframe] = {}
        self.points = np.zeros((0, 3))  # (N, 3) m in odom
        self.covariance = np.zeros((0, 3, 3))  # (N, 3, 3) m^2 in odom
        self.views = np.zeros((0, 3))  # (N, 3) px: column, lower row, upper row in the keyframe
        self.slopes = np.zeros((0, 2))  # (N, 2) px/px of the disparity about the view
        self.anchor = np.zeros(0, np.intp)  # (N,) seq of the keyframe
        self._seen = np.zeros((0, 2))  # (N, 2) px in the last panorama whose pose was accepted; NaN: not there
        self._misses = np.zeros(0, np.intp)
        self._last: PaddedPanorama | None = None

    def __len__(self) -> int:
        return len(self.points)

    def add(self, keyframe: Keyframe, views: Array, slopes: Array) -> None:
        """Takes a keyframe and its new landmarks: views (N, 3) [px] and the slopes (N, 2) of the disparity there."""
        points = triangulate(views, self._model.cylinder, self._model.baseline_m)
        finite = np.isfinite(points).all(axis=1)
        views, slopes, points = views[finite], slopes[finite], points[finite]
        covariance = point_covariance(points, self._model.cylinder, self._model.baseline_m, self._model.sigma_px)
        R = keyframe.T_odom_rect[:3, :3]
        self.keyframes[keyframe.seq] = keyframe
        self.points = np.concatenate([self.points, se3.apply(keyframe.T_odom_rect, points)])
        self.covariance = np.concatenate([self.covariance, R @ covariance @ R.T])
        self.views = np.concatenate([self.views, views])
        self.slopes = np.concatenate([self.slopes, slopes])
        self.anchor = np.concatenate([self.anchor, np.full(len(points), keyframe.seq)])
        self._seen = np.concatenate([self._seen, views[:, :2]])
        self._misses = np.concatenate([self._misses, np.zeros(len(points), np.intp)])
        self._last = keyframe.lower
        self._forget_oldest()

    def track(self, lower: PaddedPanorama, T_odom_rect: Array, most: int | None = None) -> Tracks:
        """Looks for the landmarks of the last panorama in a new one, from where a guessed pose predicts them.

        most: only about so many, evenly chosen, to compare guesses cheaply.
        """
        index, predicted = self.visible(T_odom_rect)
        known = np.isfinite(self._seen[index, 0])
        index, predicted = index[known], predicted[known]
        if most is not None:
            every = max(1, -(-len(index) // most))
            index, predicted = index[::every], predicted[::every]
        if self._last is None:
            return Tracks(index[:0], np.zeros((0, 2)), predicted[:0], 0)
        pixels, found = track(self._last, lower, self._seen[index], predicted[:, :2], self._klt)
        return Tracks(index[found], pixels[found], predicted[found], len(index))

    def visible(self, T_odom_rect: Array) -> tuple[Indices, Array]:
        """Landmarks (M,) that a pose predicts within the panorama, and their views (M, 3)."""
        predicted = view(se3.apply(se3.inverse(T_odom_rect), self.points), self._model.cylinder, self._model.baseline_m)
        bottom = self._model.cylinder.height - 1 - EDGE_ROWS
        index = np.flatnonzero((predicted[:, 1] > EDGE_ROWS) & (predicted[:, 1] < bottom))
        return index, predicted[index]

    def align(self, lower: PaddedPanorama, T_odom_rect: Array, index: Indices) -> tuple[Array, Flags]:
        """Pixels (M, 2) of landmarks (indices) by warped patches, in a panorama whose pose is known well; which fit."""
        T_rect_odom = se3.inverse(T_odom_rect)
        points = se3.apply(T_rect_odom, self.points[index])
        predicted = view(points, self._model.cylinder, self._model.baseline_m)[:, :2]
        templates = np.zeros((len(index), CELL_PX, CELL_PX), np.uint8)
        anchors = self.anchor[index]
        T_curr_ref = np.array([T_rect_odom @ self.keyframes[seq].T_odom_rect for seq in anchors.tolist()])
        warps = affine_warps(self.views[index], self.slopes[index], T_curr_ref.reshape(-1, 4, 4), self._model)
        for seq in np.unique(anchors).tolist():
            at = np.flatnonzero(anchors == seq)
            pixels = self.views[index[at], :2]
            templates[at] = warped_templates(self.keyframes[seq].lower, pixels, warps[at], predicted[at])
        return align(templates, lower, predicted)

    def anchor_shares(self, index: Indices) -> dict[int, float]:
        """For each keyframe the share of the landmarks (indices) that it anchors."""
        anchors, counts = np.unique(self.anchor[index], return_counts=True)
        return {int(a): float(n) / len(index) for a, n in zip(anchors, counts, strict=True)}

    def saw(self, lower: PaddedPanorama, index: Indices, pixels: Array) -> None:
        """Takes note of the landmarks (indices) seen in a panorama at pixels (M, 2); drops those missed too often."""
        self._last = lower
        self._seen[:] = np.nan
        self._seen[index] = pixels
        self._misses += 1
        self._misses[index] = 0
        self._select(self._misses < self._max_misses)

    def _forget_oldest(self) -> None:
        while len(self.keyframes) > self._max_keyframes:
            self.keyframes.pop(min(self.keyframes))
        self._select(np.isin(self.anchor, list(self.keyframes)))

    def _select(self, kept: Flags) -> None:
        self.points, self.covariance = self.points[kept], self.covariance[kept]
        self.views, self.slopes = self.views[kept], self.slopes[kept]
        self.anchor, self._seen, self._misses = self.anchor[kept], self._seen[kept], self._misses[kept]
        anchors = set(self.anchor.tolist())
        self.keyframes = {seq: k for seq, k in self.keyframes.items() if seq in anchors}
