"""Store of landmarks and keyframes: points relative to the keyframes that saw them first.

A landmark is anchored in the keyframe that saw it first. Its position is kept in that keyframe's rectified frame, so
that a keyframe can be moved (loop closing) and its landmarks move with it.

Bounds: at most max_keyframes keyframes K; a keyframe adds at most as many landmarks as the caller passes (F, the
features wanted), so N <= K F landmarks. A landmark leaves with its anchor or after max_misses frames without it; a
keyframe leaves when it is the oldest of too many or anchors no landmark any more.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry import landmark_kernels
from omnid.core.odometry.corners import nearby_disparity, pixels_in_upper
from omnid.core.odometry.exposure_times import AssumedMotion, Exposure
from omnid.core.odometry.plane_patches import align_rows, disparity_slopes, fitted_slopes, view_noise
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.odometry.wrong_periods import has_wrong_period
from omnid.core.stereo.triangulation import point_covariance, triangulate
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """Panorama in which landmarks are anchored; T_odom_rect is the pose of its rectified frame, covariance its own."""

    seq: int
    lower: PaddedPanorama
    T_odom_rect: Array
    covariance: Array  # (6, 6) [t; r] in the rectified frame


@dataclass(frozen=True, slots=True)
class LandmarkTable:
    """One row for each landmark.

    points and covariance in odom are computed from those in the keyframe when the keyframe is added, and again only
    when it is moved. In between they cost nothing, and their last bits stay the same whatever else is in the map.
    """

    id: Indices  # (N,) unique, in the order of addition
    anchor: Indices  # (N,) seq of the keyframe that saw the landmark first
    anchor_points: Array  # (N, 3) m in the rectified frame of the anchor
    anchor_covariance: Array  # (N, 3, 3) m^2 in the same axes
    views: Array  # (N, 3) px in the anchor, at its stamp: column, lower row, upper row
    anchor_pixels: Array  # (N, 2) px where the anchor's lower panorama shows it
    slopes: Array  # (N, 2) px/px of the disparity about the view, along column and row
    points: Array  # (N, 3) m in odom
    covariance: Array  # (N, 3, 3) m^2 in odom
    pixels: Array  # (N, 2) px in the last accepted panorama, NaN: not found there
    misses: Indices  # (N,) consecutive accepted frames in which the landmark was no inlier

    @staticmethod
    def empty() -> LandmarkTable:
        """Return a table without rows."""
        none, vectors, matrices = np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 3, 3))
        pixels = np.zeros((0, 2))
        return LandmarkTable(none, none, vectors, matrices, vectors, pixels, pixels, vectors, matrices, pixels, none)


class LandmarkStore:
    """Keyframes by seq, and their landmarks."""

    def __init__(self, model: StereoModel, max_keyframes: int = 8, max_misses: int = 3) -> None:
        self._model, self._max_keyframes, self._max_misses = model, max_keyframes, max_misses
        self._next_id = 0
        self.clear()

    def clear(self) -> None:
        """Remove all keyframes and landmarks."""
        self.keyframes: dict[int, Keyframe] = {}
        self.table = LandmarkTable.empty()

    def __len__(self) -> int:
        return len(self.table.id)

    def add_keyframe(
        self, keyframe: Keyframe, views: Array, slopes: Array, noise: Array | None = None, pixels: Array | None = None
    ) -> Indices:
        """Add a keyframe with new landmarks, and remove the oldest keyframe beyond the bound.

        views (N, 3) [px]: those of the landmarks. slopes (N, 2): those of the disparity. noise: covariance (N, 3, 3)
        [px^2] of the views in addition to that of the model; None: none. pixels (N, 2): those in the keyframe's
        panorama, which differ from the views where it was exposed at several times; None: those of the views. Return
        the ids (N,) of the landmarks; -1 for views that cannot be triangulated, which are left out.
        """
        points = triangulate(views, self._model.cylinder, self._model.baseline_m)
        finite = np.isfinite(points).all(axis=1)
        pixels = (views[:, :2] if pixels is None else pixels)[finite]
        views, slopes, points = views[finite], slopes[finite], points[finite]
        covariance = point_covariance(
            points,
            self._model.cylinder,
            self._model.baseline_m,
            self._model.sigma_px,
            None if noise is None else noise[finite],
        )
        count = len(points)
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        in_odom = _in_odom(keyframe, points, covariance)
        new = LandmarkTable(
            ids,
            np.full(count, keyframe.seq),
            points,
            covariance,
            views,
            pixels,
            slopes,
            *in_odom,
            pixels=pixels,
            misses=np.zeros(count, np.intp),
        )
        self.keyframes[keyframe.seq] = keyframe
        self.table = _joined(self.table, new)
        while len(self.keyframes) > self._max_keyframes:
            self.keyframes.pop(min(self.keyframes))
        self._select(np.isin(self.table.anchor, list(self.keyframes)))
        given = np.full(finite.shape, -1)
        given[finite] = ids
        return given

    def rows(self, ids: Indices) -> tuple[Indices, Flags]:
        """Return the rows (M,) of those landmarks that are still kept, and which (N,) of the ids these are."""
        rows = np.searchsorted(self.table.id, ids)
        known = np.isin(ids, self.table.id)
        return rows[known], known

    def replace_views(self, ids: Indices, views: Array, noise: Array) -> None:
        """Set the views (N, 3) [px] of landmarks (ids) in their anchors, and their noise as in `add_keyframe`.

        Where a view cannot be triangulated the landmark stays as it is.
        """
        rows, known = self.rows(ids)
        points = triangulate(views[known], self._model.cylinder, self._model.baseline_m)
        finite = np.isfinite(points).all(axis=1)
        rows, points, views, noise = rows[finite], points[finite], views[known][finite], noise[known][finite]
        spread = point_covariance(points, self._model.cylinder, self._model.baseline_m, self._model.sigma_px, noise)
        before = self.table
        found = LandmarkTable(*(getattr(before, column.name).copy() for column in fields(before)))
        found.anchor_points[rows], found.anchor_covariance[rows], found.views[rows] = points, spread, views
        for seq in np.unique(before.anchor[rows]).tolist():
            own = rows[before.anchor[rows] == seq]
            found.points[own], found.covariance[own] = _in_odom(
                self.keyframes[seq], found.anchor_points[own], found.anchor_covariance[own]
            )
        self.table = found

    def update_depths(self, rows: Indices, disparity: Array, variance: Array, T_odom_rect: Array) -> None:
        """Correct the points of landmarks (rows (M,) of the table) by disparities (M,) [px] measured at a pose.

        variance (M,) [px^2] of the disparities; NaN disparities are ignored. A Kalman update of each point in its
        anchor's frame, by the disparity alone: that depends on the depth, and hardly on the error of the pose. The
        errors of one texture are alike from frame to frame, so each counts as several times as uncertain.
        """
        before, (T_odom_keyframe, keyframe) = self.table, self._anchors(rows)
        corrected = (
            before.anchor_points.copy(),
            before.anchor_covariance.copy(),
            before.points.copy(),
            before.covariance.copy(),
        )
        landmark_kernels.update_depths(
            rows,
            disparity,
            variance,
            keyframe,
            se3.inverse(T_odom_rect) @ T_odom_keyframe,
            T_odom_keyframe,
            self._model.camera,
            self._model.sigma_px,
            *corrected,
        )
        self.table = replace(
            before,
            anchor_points=corrected[0],
            anchor_covariance=corrected[1],
            points=corrected[2],
            covariance=corrected[3],
        )

    def update_tracked(self, rows: Indices, pixels: Array) -> None:
        """Record the inliers (rows of the table) of an accepted frame with their pixels (M, 2).

        Landmarks that were no inliers in max_misses consecutive frames are removed.
        """
        seen = np.full((len(self), 2), np.nan)
        seen[rows] = pixels
        misses = self.table.misses + 1
        misses[rows] = 0
        self.table = replace(self.table, pixels=seen, misses=misses)
        if (misses >= self._max_misses).any():
            self._select(misses < self._max_misses)

    def give_up(self, rows: Indices) -> None:
        """Let landmarks (rows of the table) be removed at the next `update_tracked`, unless they are inliers in it."""
        misses = self.table.misses.copy()
        misses[rows] = self._max_misses
        self.table = replace(self.table, misses=misses)

    def keep(self, ids: Indices) -> None:
        """Remove all landmarks but these."""
        self._select(np.isin(self.table.id, ids))

    def from_anchors(self, T_rect_odom: Array, rows: Indices) -> Array:
        """Return the transforms (M, 4, 4) into a rectified frame from the anchors of landmarks (rows of the table)."""
        T_odom_anchor, keyframe = self._anchors(rows)
        return np.asarray((T_rect_odom @ T_odom_anchor)[keyframe])

    def _anchors(self, rows: Indices) -> tuple[Array, Indices]:
        """Return the poses (K, 4, 4) of the keyframes, and which (M,) of them anchor landmarks (rows of the table)."""
        seqs = sorted(self.keyframes)
        poses = np.array([self.keyframes[seq].T_odom_rect for seq in seqs]).reshape(-1, 4, 4)
        return poses, np.searchsorted(np.array(seqs, np.intp), self.table.anchor[rows])

    def anchor_shares(self, rows: Indices) -> dict[int, float]:
        """Return for each keyframe the share of the landmarks (rows of the table) that it anchors."""
        anchors, counts = np.unique(self.table.anchor[rows], return_counts=True)
        return {int(a): float(n) / len(rows) for a, n in zip(anchors, counts, strict=True)}

    def _select(self, kept: Flags) -> None:
        """Keep some landmarks (flags (N,)) and the keyframes that anchor them."""
        self.table = _selected(self.table, kept)
        anchors = set(self.table.anchor.tolist())
        self.keyframes = {seq: keyframe for seq, keyframe in self.keyframes.items() if seq in anchors}


def _in_odom(keyframe: Keyframe, points: Array, covariance: Array) -> tuple[Array, Array]:
    """Return points (N, 3) [m] and covariances (N, 3, 3) [m^2] of a keyframe's rectified frame in odom."""
    found = np.empty(points.shape), np.empty(covariance.shape)
    landmark_kernels.place_all(points, covariance, keyframe.T_odom_rect, *found)
    return found


def _selected(table: LandmarkTable, kept: Flags) -> LandmarkTable:
    """Return the rows of a table for which kept (N,) is true."""
    return LandmarkTable(*(getattr(table, column.name)[kept] for column in fields(table)))


def _joined(first: LandmarkTable, second: LandmarkTable) -> LandmarkTable:
    """Return the rows of two tables."""
    return LandmarkTable(
        *(np.concatenate([getattr(first, column.name), getattr(second, column.name)]) for column in fields(first))
    )


# Half the distance over which the correction of a slope for the motion is taken.
SLOPE_STEP_PX = 4.0


@dataclass(frozen=True, slots=True)
class NewLandmarks:
    """Landmarks that were located in both panoramas of a keyframe."""

    pixels: Array  # (N, 2) px in the lower panorama
    views: Array  # (N, 3) px, at the stamp
    slopes: Array  # (N, 2) px/px of the disparity, at the stamp
    noise: Array  # (N, 3, 3) px^2 of the views, that of the motion left out
    assumed: AssumedMotion  # motion by which the views were corrected

    @property
    def whole_noise(self) -> Array:
        """Covariance (N, 3, 3) [px^2] of the views, also by the uncertain motion."""
        velocity, J = self.assumed
        return np.asarray(self.noise + J @ velocity.covariance @ np.swapaxes(J, 1, 2))


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
    pixels, rows, slopes = corners[found], rows[found], slopes[found]
    noise = view_noise(np.zeros((2, 2)), variance[found])

    # 3. Correct the views for the motion during the exposures.
    views, _ = exposure.corrected(pixels, rows)
    assumed = AssumedMotion(exposure.motion, exposure.derivatives(views))
    return NewLandmarks(pixels, views, _at_stamp(slopes, pixels, rows, exposure), noise, assumed)


def _at_stamp(slopes: Array, pixels: Array, rows: Array, exposure: Exposure) -> Array:
    """Return slopes (N, 2) at the stamp from slopes between the exposures at pixels (N, 2) with upper rows (N,)."""
    corrected = np.empty(slopes.shape)
    for axis, step in enumerate(SLOPE_STEP_PX * np.eye(2)):
        ends = []
        for sign in (1, -1):
            there, above = pixels + sign * step, rows + sign * (step[1] + SLOPE_STEP_PX * slopes[:, axis])
            views, _ = exposure.corrected(there, above)
            ends.append((views[:, 2] - views[:, 1]) - (above - there[:, 1]))
        corrected[:, axis] = slopes[:, axis] + (ends[0] - ends[1]) / (2 * SLOPE_STEP_PX)
    return np.where(np.isfinite(corrected), corrected, slopes)
