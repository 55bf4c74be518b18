"""Local map: landmarks relative to the keyframes that saw them first, their prediction, tracking and alignment.

A landmark is anchored in the keyframe that saw it first. Its position is kept in that keyframe's rectified frame, so
that its error is that of one pair, and that of the keyframe's pose comes in once.

Bounds: at most max_keyframes keyframes K; a keyframe adds at most as many landmarks as the caller passes (F, the
features wanted), so N <= K F landmarks. A landmark leaves with its anchor or after max_misses frames without it; a
keyframe leaves when it anchors no landmark any more, or of too many the oldest that anchors no more than half of all:
where few corners are in view each keyframe adds a few, and the oldest one may anchor nearly all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import MIN_RADIUS, at_pixels
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import RigVelocity
from omnid.core.odometry.patch_kernels import write_moved_slopes
from omnid.core.odometry.plane_patches import REACH_PX, WINDOW_PX, AlignedPatches, align, plane_templates
from omnid.core.odometry.pose_estimation import CORRELATED, OUTLIER_SQUARED, POSE
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import point_covariance, triangulate, view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

COARSE_ITERATIONS = 8  # Iterations of Lucas-Kanade on each level, few because the patches are aligned afterwards.
# Px: a landmark predicted nearer to the panorama's upper or lower edge is not tracked.
EDGE_ROWS = 3

# One row of the table for each landmark. Points and covariance in odom follow from those in the anchor.
LANDMARK = np.dtype(
    [
        ("id", np.intp),  # unique, in the order of addition
        ("anchor", np.intp),  # seq of the keyframe that saw the landmark first
        ("anchor_points", float, 3),  # m in the rectified frame of the anchor
        ("anchor_covariance", float, (3, 3)),  # m^2 in the same axes
        ("anchor_pixels", float, 2),  # px where the anchor's lower panorama shows it
        ("slopes", float, 2),  # px/px of the disparity about the view, along column and row
        ("points", float, 3),  # m in odom
        ("covariance", float, (3, 3)),  # m^2 in odom
        ("pixels", float, 2),  # px in the last accepted panorama, NaN: not found there
        ("misses", np.intp),  # consecutive accepted frames in which the landmark was no inlier
    ]
)


@dataclass(frozen=True, slots=True)
class Keyframe:
    """Panorama in which landmarks are anchored; T_odom_rect is the pose of its rectified frame.

    Each was found by those before it, so that they share errors: they are sums of K independent draws of one sigma.
    """

    seq: int
    lower: PaddedPanorama
    T_odom_rect: Array
    error: Array  # (6, K) [t; r] of the pose in the rectified frame, by the draws


@dataclass(frozen=True, slots=True)
class NewLandmarks:
    """Landmarks that were located in both panoramas of a keyframe."""

    pixels: Array  # (N, 2) px in the lower panorama
    views: Array  # (N, 3) px, at the stamp
    slopes: Array  # (N, 2) px/px of the disparity
    noise: Array  # (N, 3, 3) px^2 of the views, in addition to that of the model


@dataclass(frozen=True, slots=True)
class Tracks:
    """Landmarks that were tracked into a new panorama."""

    landmarks: Indices  # (M,) rows of the table of landmarks
    pixels: Array  # (M, 2) px where they were found
    predicted: Array  # (M, 3) px: views that the guessed pose predicts
    visible: int  # landmarks that were searched: those predicted within the panorama, or a sample of them
    each_counts: float = 1.0  # landmarks within the panorama, for each that was searched


class LocalMap:
    """Keyframes by seq, their landmarks, and the last panorama in which these were found: the only writer of them."""

    def __init__(self, model: StereoModel, klt: KltSettings, max_keyframes: int = 8, max_misses: int = 3) -> None:
        self._model, self._max_keyframes, self._max_misses = model, max_keyframes, max_misses
        self._coarse_klt = replace(klt, iterations=min(klt.iterations, COARSE_ITERATIONS))
        self._near_klt = replace(self._coarse_klt, levels=0)
        self._next_id = 0
        self.lost: NDArray[np.bool_] | None = None  # (H, W) of the frame, in which no landmark is searched; None: none
        self.clear()

    def __len__(self) -> int:
        return len(self._rows)

    def clear(self) -> None:
        """Remove all landmarks and keyframes."""
        self.keyframes: dict[int, Keyframe] = {}
        self._set_rows(np.zeros(0, LANDMARK))
        self.last: PaddedPanorama | None = None  # the last accepted lower panorama; None: there is no map
        # The estimate that waits for the velocity at its frame, with the ids of its landmarks.
        self._seen: tuple[Indices, PoseEstimate] | None = None

    def add_keyframe(self, keyframe: Keyframe, located: NewLandmarks) -> Flags:
        """Add a keyframe at the last panorama with new landmarks, and remove one beyond the bound.

        Return flags (N,) of those that can be triangulated; the others are left out.
        """
        self.last = keyframe.lower
        points = triangulate(located.views, self._model.cylinder, self._model.baseline_m)
        finite = np.asarray(np.isfinite(points).all(axis=1))
        new = np.zeros(int(finite.sum()), LANDMARK)
        new["id"] = np.arange(self._next_id, self._next_id + len(new))
        self._next_id += len(new)
        new["anchor"], new["slopes"] = keyframe.seq, located.slopes[finite]
        new["pixels"] = new["anchor_pixels"] = located.pixels[finite]
        self.keyframes[keyframe.seq] = keyframe
        self._set_rows(np.concatenate([self._rows, new]))
        camera = self._model.cylinder, self._model.baseline_m, self._model.sigma_px
        covariance = point_covariance(points[finite], *camera, located.noise[finite])
        self._place(np.arange(len(self) - len(new), len(self)), points[finite], covariance)
        if len(self.keyframes) > self._max_keyframes:
            counts = {seq: int((self._rows["anchor"] == seq).sum()) for seq in self.keyframes}
            others, half = counts.keys() - {keyframe.seq}, len(self._rows) / 2
            self.keyframes.pop(min(others, key=lambda seq: (counts[seq] > half, seq)))
        self._select(np.isin(self.table.anchor, list(self.keyframes)))
        # The newest one has a draw more. No more are needed than the errors have numbers: a root of their covariance.
        count = keyframe.error.shape[1]
        errors = [np.pad(each.error, ((0, 0), (0, count - each.error.shape[1]))) for each in self.keyframes.values()]
        root = np.asarray(np.linalg.qr(np.reshape(errors, (-1, count)).T, mode="r")).T
        for n, (seq, each) in enumerate(self.keyframes.items()):
            self.keyframes[seq] = replace(each, error=root[POSE * n : POSE * (n + 1)])
        return finite

    def settle(self, velocity: RigVelocity | None) -> None:
        """Correct depths by the estimate that waits, with the velocity at it; None: no better one than was assumed."""
        if self._seen is not None:
            ids, estimate = self._seen
            self._correct(ids, estimate, velocity or estimate.assumed)
        self._seen = None

    def accept(self, lower: PaddedPanorama, estimate: PoseEstimate) -> None:
        """Record the inliers of an accepted pose, and correct depths, at once or when the velocity is known."""
        ids = self.table.id[estimate.landmarks]
        if estimate.by_motion.shape[1]:
            self._seen = ids, estimate
        else:
            self._correct(ids, estimate, estimate.assumed)
        self.update_tracked(lower, estimate.landmarks, estimate.pixels)

    def _correct(self, ids: Indices, estimate: PoseEstimate, velocity: RigVelocity) -> None:
        """Correct the points of landmarks (ids (M,)) by their views in an estimate; those without upper row stay.

        A Kalman update of each point in its anchor's frame, by the disparity alone: that depends on the depth, and
        hardly on the error of the pose. The errors of one texture are correlated from frame to frame, so each variance
        is enlarged.
        """
        kept = np.isin(ids, self.table.id) & np.isfinite(estimate.views[:, 2])
        rows = np.searchsorted(self.table.id, ids[kept])
        J, views = estimate.by_motion[kept], estimate.views[kept]
        disparity = views[:, 2] - views[:, 1] + J @ (velocity.twist - estimate.assumed.twist)
        variance = estimate.variance[kept] + np.einsum("ni,ij,nj->n", J, velocity.covariance, J)
        # 1. The disparity f t / r as predicted, and its derivatives by the point in the anchor.
        seen, T_curr_anchor = self.seen(estimate.T_odom_rect, rows)
        points, P = self.table.anchor_points[rows], self.table.anchor_covariance[rows]
        r2 = np.maximum((seen[:, :2] ** 2).sum(axis=1), MIN_RADIUS**2)
        predicted = self._model.cylinder.focal_px * self._model.baseline_m / np.sqrt(r2)
        H = np.einsum("ni,nij->nj", -(predicted / r2)[:, None] * seen[:, :2], T_curr_anchor[:, :2, :3])
        # 2. The update, without outliers.
        PH = np.einsum("nij,nj->ni", P, H)
        S = (H * PH).sum(axis=1) + CORRELATED * (variance + 2 * self._model.sigma_px**2)
        innovation = disparity - predicted
        right = innovation**2 < OUTLIER_SQUARED * S
        rows, gain = rows[right], (PH / S[:, None])[right]
        points = points[right] + gain * innovation[right, None]
        self._place(rows, points, P[right] - gain[:, :, None] * PH[right, None])

    def _place(self, rows: Indices, points: Array, covariance: Array) -> None:
        """Set points (M, 3) and covariances (M, 3, 3) of landmarks (rows) in their anchors, and so in odom."""
        table = self.table
        table.anchor_points[rows], table.anchor_covariance[rows] = points, covariance
        table.points[rows], T_odom_anchor = self.seen(np.eye(4), rows)
        R = T_odom_anchor[:, :3, :3]
        table.covariance[rows] = R @ covariance @ np.swapaxes(R, 1, 2)

    def update_tracked(self, lower: PaddedPanorama, rows: Indices, pixels: Array) -> None:
        """Record in which pixels (M, 2) of a panorama landmarks (rows of the table) were found.

        Landmarks that were not found in max_misses consecutive frames are removed.
        """
        table, self.last = self.table, lower
        table.pixels[:] = np.nan
        table.pixels[rows] = pixels
        table.misses[:] += 1
        table.misses[rows] = 0
        if (table.misses >= self._max_misses).any():
            self._select(table.misses < self._max_misses)

    def remove(self, rows: Indices) -> None:
        """Remove landmarks (rows of the table)."""
        self._select(~np.isin(np.arange(len(self)), rows))

    def from_anchors(self, T_odom_rect: Array, rows: Indices) -> Array:
        """Return the transforms (M, 4, 4) into the frame with a pose, from the anchors of landmarks (rows)."""
        seqs = sorted(self.keyframes)
        poses = se3.inverse(T_odom_rect) @ np.array([self.keyframes[seq].T_odom_rect for seq in seqs]).reshape(-1, 4, 4)
        return np.asarray(poses[np.searchsorted(np.array(seqs, np.intp), self.table.anchor[rows])])

    def seen(self, T_odom_rect: Array, rows: Indices) -> tuple[Array, Array]:
        """Return landmarks (M, 3) [m] in the frame with a pose, by their places in the anchors; and `from_anchors`."""
        T = self.from_anchors(T_odom_rect, rows)
        return (T[:, :3, :3] @ self.table.anchor_points[rows][:, :, None])[:, :, 0] + T[:, :3, 3], T

    def _set_rows(self, rows: NDArray[np.void]) -> None:
        """Set the rows (N,) of LANDMARK; the columns of the table are views of them."""
        self._rows, self.table = rows, SimpleNamespace(**{name: rows[name] for name in LANDMARK.fields or ()})

    def _select(self, kept: Flags) -> None:
        """Keep some landmarks (flags (N,)) and the keyframes that anchor them."""
        self._set_rows(self._rows[kept])
        anchors = set(self.table.anchor.tolist())
        self.keyframes = {seq: keyframe for seq, keyframe in self.keyframes.items() if seq in anchors}

    def track(
        self,
        lower: PaddedPanorama,
        T_odom_rect: Array,
        max_count: int | None = None,
        *,
        phase: int = 0,
        near: bool = False,
    ) -> Tracks:
        """Track landmarks of the last panorama into a new one, from the pixels that a guessed pose predicts.

        max_count: about this number of landmarks, evenly chosen; None: all. phase: selects which ones. near: the guess
        is good to a few pixels, so that no pyramid is needed; where it is not, wrong tracks pass the check.
        """
        rows, predicted = self.visible(T_odom_rect)
        known = np.isfinite(self.table.pixels[rows, 0])
        rows, predicted = rows[known], predicted[known]
        count = len(rows)
        if max_count is not None:
            every = max(1, -(-count // max_count))
            chosen = np.flatnonzero((self.table.id[rows] + phase) % every == 0)
            rows, predicted = rows[chosen], predicted[chosen]
        if self.last is None:
            return Tracks(rows[:0], np.zeros((0, 2)), predicted[:0], 0)
        before = self.table.pixels[rows]
        pixels, found = track(self.last, lower, before, predicted[:, :2], self._near_klt if near else self._coarse_klt)
        return Tracks(rows[found], pixels[found], predicted[found], len(rows), count / max(1, len(rows)))

    def visible(self, T_odom_rect: Array) -> tuple[Indices, Array]:
        """Return the landmarks (M,) that a pose predicts in live parts of the panorama, and their views (M, 3) [px]."""
        points = se3.apply(se3.inverse(T_odom_rect), self.table.points)
        predicted = view(points, self._model.cylinder, self._model.baseline_m)
        bottom = self._model.cylinder.height - 1 - EDGE_ROWS
        is_inside = (predicted[:, 1] > EDGE_ROWS) & (predicted[:, 1] < bottom)
        is_inside &= self._model.cylinder.shows(predicted[:, 0])
        if self.lost is not None:
            is_inside &= ~at_pixels(self.lost, predicted[:, :2])
        rows = np.flatnonzero(is_inside)
        return rows, predicted[rows]

    def align(
        self,
        panorama: PaddedPanorama,
        T_odom_rect: Array,
        landmarks: Indices,
        predicted: Array,
        reach_px: int = REACH_PX,
        *,
        upper: bool = False,
    ) -> AlignedPatches:
        """Align the keyframes' patches of landmarks (M,) with a panorama whose pose is known well.

        predicted (M, 2): their pixels by that pose. A patch is found where it has texture and moved by less than
        reach_px from there. upper: it is the upper panorama.
        """
        table, T_rect_odom = self.table, se3.inverse(T_odom_rect)
        templates = np.empty((len(landmarks), WINDOW_PX + 2, WINDOW_PX + 2), np.float32)
        for seq, keyframe in self.keyframes.items():
            own = np.flatnonzero(table.anchor[landmarks] == seq)
            rows, T_curr_ref = landmarks[own], T_rect_odom @ keyframe.T_odom_rect
            pixels, surfaces = table.anchor_pixels[rows], (table.anchor_points[rows], table.slopes[rows])
            seen = T_curr_ref, predicted[own], self._model
            templates[own] = plane_templates(keyframe.lower, pixels, surfaces, *seen, upper=upper)
        return align(templates, panorama, predicted, reach_px)

    def slopes(self, T_odom_rect: Array, landmarks: Indices) -> Array:
        """Return the slopes (M, 2) of the disparity of landmarks (M,) [px/px] in a panorama with that pose."""
        T_curr_ref, moved = self.from_anchors(T_odom_rect, landmarks), np.empty((len(landmarks), 2))
        planes = self.table.anchor_points[landmarks], self.table.slopes[landmarks]
        write_moved_slopes(*planes, T_curr_ref, self._model.baseline_m, moved)
        return moved

    def error_of(self, estimate: PoseEstimate) -> Array:
        """Return the error (6, K) that the keyframes pass on to a pose: each moves its landmarks, and they the pose."""
        keyframes, anchors = list(self.keyframes.values()), self.table.anchor[estimate.landmarks]
        by_keyframe = np.array([estimate.by_landmark[anchors == each.seq].sum(axis=0) for each in keyframes])
        A = se3.adjoint(se3.inverse(estimate.T_odom_rect) @ np.array([each.T_odom_rect for each in keyframes]))
        return np.asarray((by_keyframe @ A @ np.array([each.error for each in keyframes])).sum(axis=0))
