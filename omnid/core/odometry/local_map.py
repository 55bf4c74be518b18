"""Local map: prediction, tracking and alignment of the landmarks near the robot, and their depths a frame later."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import PoseEstimate
from omnid.core.odometry.exposure_times import RigVelocity
from omnid.core.odometry.first_depths import FirstDepths
from omnid.core.odometry.landmarks import Keyframe, LandmarkStore, NewLandmarks
from omnid.core.odometry.plane_patches import AlignedPatches, align, moved_slopes, plane_templates
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

COARSE_ITERATIONS = 8  # Iterations of Lucas-Kanade on each level, few because the patches are aligned afterwards.
# Reach of the alignment, because a new landmark, whose depth is uncertain, may be off by more than a pixel.
REACH_PX = 2
# Px: a landmark predicted nearer to the panorama's upper or lower edge is not tracked.
EDGE_ROWS = 3


@dataclass(frozen=True, slots=True)
class Tracks:
    """Landmarks that were tracked into a new panorama."""

    landmarks: Indices  # (M,) rows of the table of landmarks
    pixels: Array  # (M, 2) px where they were found
    predicted: Array  # (M, 3) px: views that the guessed pose predicts
    visible: int  # landmarks that were searched: those predicted within the panorama, or a sample of them
    each_counts: float = 1.0  # landmarks within the panorama, for each that was searched

    def without(self, landmarks: Indices) -> Tracks:
        """Return the tracks of other landmarks than these (K,)."""
        others = ~np.isin(self.landmarks, landmarks)
        return replace(
            self, landmarks=self.landmarks[others], pixels=self.pixels[others], predicted=self.predicted[others]
        )


class LocalMap:
    """Landmarks in a store, and the last panorama in which they were found."""

    def __init__(self, model: StereoModel, klt: KltSettings, max_keyframes: int = 8, max_misses: int = 3) -> None:
        self._model, self._klt = model, klt
        self._coarse_klt = replace(klt, iterations=min(klt.iterations, COARSE_ITERATIONS))
        self._near_klt = replace(self._coarse_klt, levels=0)
        self.store = LandmarkStore(model, max_keyframes, max_misses)
        self.late_depths = LateDepths(self.store)
        self.first_depths: FirstDepths | None = None  # of the only keyframe; None: its depths are not in doubt
        self._last: PaddedPanorama | None = None
        self.lost: NDArray[np.bool_] | None = None  # (H, W) of the frame, in which no landmark is searched; None: none

    def __len__(self) -> int:
        return len(self.store)

    def clear(self) -> None:
        """Remove all landmarks and keyframes."""
        self.store.clear()
        self.late_depths.clear()
        self.first_depths = self._last = None

    def add_keyframe(
        self, keyframe: Keyframe, views: Array, slopes: Array, noise: Array | None = None, pixels: Array | None = None
    ) -> Indices:
        """Add a keyframe at the last panorama with new landmarks: see LandmarkStore.add_keyframe."""
        self._last = keyframe.lower
        return self.store.add_keyframe(keyframe, views, slopes, noise, pixels)

    def decide_first_depths(self, lower: PaddedPanorama, step_m: tuple[float, float]) -> None:
        """Let a new panorama decide among the depths of the first keyframe; step_m: see FirstDepths.decide."""
        if self.first_depths is not None:
            self.first_depths.decide(lower, self._coarse_klt, self.store, step_m)
            if not self.first_depths.is_open:
                self.first_depths = None

    def update_tracked(self, lower: PaddedPanorama, landmarks: Indices, pixels: Array) -> None:
        """Record the inliers (rows of the table) of an accepted panorama with their pixels (M, 2)."""
        self.store.update_tracked(landmarks, pixels)
        self._last = lower

    def track(
        self, lower: PaddedPanorama, T_odom_rect: Array, most: int | None = None, *, turn: int = 0, near: bool = False
    ) -> Tracks:
        """Track landmarks of the last panorama into a new one, from the pixels that a guessed pose predicts.

        most: about this number of landmarks, evenly chosen; None: all. turn: selects which ones. near: the guess is
        good to a few pixels, so that no pyramid is needed; where it is not, wrong tracks pass the check.
        """
        rows, predicted = self.visible(T_odom_rect)
        known = np.isfinite(self.store.table.pixels[rows, 0])
        rows, predicted = rows[known], predicted[known]
        count = len(rows)
        if most is not None:
            every = max(1, -(-count // most))
            chosen = np.flatnonzero((self.store.table.id[rows] + turn) % every == 0)
            rows, predicted = rows[chosen], predicted[chosen]
        if self._last is None:
            return Tracks(rows[:0], np.zeros((0, 2)), predicted[:0], 0)
        before = self.store.table.pixels[rows]
        pixels, found = track(self._last, lower, before, predicted[:, :2], self._near_klt if near else self._coarse_klt)
        return Tracks(rows[found], pixels[found], predicted[found], len(rows), count / max(1, len(rows)))

    def last_seen(self, most: int) -> tuple[PaddedPanorama | None, Indices]:
        """Return the last panorama, and about `most` evenly chosen landmarks (M,) that were found in it."""
        rows = np.flatnonzero(np.isfinite(self.store.table.pixels[:, 0]))
        return self._last, rows[:: max(1, -(-len(rows) // most))]

    def visible(self, T_odom_rect: Array) -> tuple[Indices, Array]:
        """Return the landmarks (M,) that a pose predicts in live parts of the panorama, and their views (M, 3) [px]."""
        points = se3.apply(se3.inverse(T_odom_rect), self.store.table.points)
        predicted = view(points, self._model.cylinder, self._model.baseline_m)
        bottom = self._model.cylinder.height - 1 - EDGE_ROWS
        is_inside = (predicted[:, 1] > EDGE_ROWS) & (predicted[:, 1] < bottom)
        is_inside &= self._model.cylinder.shows(predicted[:, 0])
        if self.lost is not None:
            height, width = self.lost.shape
            columns = np.rint(np.nan_to_num(predicted[:, 0])).astype(np.intp) % width
            pixel_rows = np.clip(np.rint(np.nan_to_num(predicted[:, 1])), 0, height - 1).astype(np.intp)
            is_inside &= ~self.lost[pixel_rows, columns]
        rows = np.flatnonzero(is_inside)
        return rows, predicted[rows]

    def align(self, lower: PaddedPanorama, T_odom_rect: Array, landmarks: Indices, predicted: Array) -> AlignedPatches:
        """Align the keyframes' patches of landmarks (M,) with a panorama whose pose is known well.

        predicted (M, 2): their pixels by that pose. A patch is found where it has texture and moved little from there.
        """
        table, keyframes = self.store.table, self.store.keyframes
        anchors = table.anchor[landmarks]
        T_curr_ref = self.store.from_anchors(se3.inverse(T_odom_rect), landmarks)
        surfaces = table.anchor_points[landmarks], table.slopes[landmarks]
        images = {seq: keyframe.lower for seq, keyframe in keyframes.items()}
        templates = plane_templates(
            images, anchors, table.anchor_pixels[landmarks], surfaces, T_curr_ref, self._model, predicted
        )
        return align(templates, lower, predicted, anchors, REACH_PX)

    def slopes(self, T_odom_rect: Array, landmarks: Indices) -> Array:
        """Return the slopes (M, 2) of the disparity of landmarks (M,) [px/px] in a panorama with that pose."""
        table, T_curr_ref = self.store.table, self.store.from_anchors(se3.inverse(T_odom_rect), landmarks)
        return moved_slopes((table.anchor_points[landmarks], table.slopes[landmarks]), T_curr_ref, self._model)

    def covariance_of(self, estimate: PoseEstimate) -> Array:
        """Return the covariance (6, 6) that the keyframes in which the inliers are anchored pass on to a pose."""
        shares = self.store.anchor_shares(estimate.landmarks)
        if not shares:
            return np.zeros((6, 6))
        keyframes = [self.store.keyframes[seq] for seq in shares]
        poses = np.array([keyframe.T_odom_rect for keyframe in keyframes])
        covariance = np.array([keyframe.covariance for keyframe in keyframes])
        A = se3.adjoint(se3.inverse(estimate.T_odom_rect) @ poses)
        weighted = np.array(list(shares.values()))[:, None, None] * A
        return np.asarray((weighted @ covariance @ np.swapaxes(A, 1, 2)).sum(axis=0))


class LateDepths:
    """Measurements of the last frame of the landmarks in a store; at most one frame waits."""

    def __init__(self, store: LandmarkStore) -> None:
        self._store = store
        self.clear()

    def clear(self) -> None:
        """Forget what waits."""
        self._seen: tuple[Indices, PoseEstimate] | None = None
        self._added: tuple[Indices, NewLandmarks] | None = None

    def seen(self, ids: Indices, estimate: PoseEstimate) -> None:
        """Correct the depths of the landmarks (N,) of an estimate, at once or when the velocity is known."""
        if estimate.assumed.is_final:
            disparity = estimate.views[:, 2] - estimate.views[:, 1]
            self._store.update_depths(estimate.landmarks, disparity, estimate.variance, estimate.T_odom_rect)
        else:
            self._seen = ids, estimate

    def added(self, ids: Indices, new: NewLandmarks) -> None:
        """Correct the landmarks of a new keyframe, whose ids are (N,), when the velocity is known."""
        self._added = None if new.assumed.is_final else (ids, new)

    def settle(self, velocity: RigVelocity | None) -> None:
        """Correct the map by what waits, with the velocity at that frame; None: no better one than was assumed."""
        if self._added is not None and velocity is not None:
            ids, new = self._added
            assumed, J = new.assumed
            views = new.views + J @ (velocity.twist - assumed.twist)
            self._store.replace_views(ids, views, new.noise + J @ velocity.covariance @ np.swapaxes(J, 1, 2))
        if self._seen is not None:
            ids, estimate = self._seen
            assumed, J = estimate.assumed
            known = assumed if velocity is None else velocity
            disparity = estimate.views[:, 2] - estimate.views[:, 1] + J @ (known.twist - assumed.twist)
            variance = estimate.variance + np.einsum("ni,ij,nj->n", J, known.covariance, J)
            rows, kept = self._store.rows(ids)
            self._store.update_depths(rows, disparity[kept], variance[kept], estimate.T_odom_rect)
        self.clear()
