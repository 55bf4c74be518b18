"""The search for the pose of a frame in the local map: guesses, each tracked, estimated and refined, and others.

Equations and sections are those of Dang et al. 2012.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import REACH_PX
from omnid.core.odometry.estimates import SAME_M, OdometryLimits, PoseEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_hypotheses import LANDMARKS, displacements, likely
from omnid.core.odometry.plane_patches import align_rows, view_noise
from omnid.core.odometry.pose_estimation import (
    CORRELATED,
    OUTLIER_SQUARED,
    GaussNewtonResult,
    cost,
    gauss_newton,
    ransac,
)
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import correlation_peaks
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

# Fewer landmarks are no estimate of six unknowns, because three determine them, and as many must confirm it.
MIN_LANDMARKS = 6
# Standard deviation of a track whose patch was not yet warped to the new viewpoint.
COARSE_SIGMA_PX = 0.3
# Cost of a landmark that is no inlier: that of the last one.
OUTLIER_COST = float(cost(OUTLIER_SQUARED))
# Share of the predicted landmarks, tracked, below which another guess is tried; the same of inliers near a guess, as
# without a pyramid tracks stay, in noise, near a wrong prediction and confirm it.
GOOD_RATIO = 0.5
# Landmarks tracked from the last panorama at most, as a share of those wanted, others in the next frame: enough for the
# start of the refinement, which aligns the patches of all landmarks.
TRACKED_SHARE = 0.6


class PoseSearch:
    """Finds a frame in the local map."""

    def __init__(self, local_map: LocalMap, model: StereoModel, limits: OdometryLimits) -> None:
        self._map, self._model, self._limits = local_map, model, limits
        # Number of landmarks that are tracked at most.
        self._tracked = max(2 * limits.good_inliers, round(TRACKED_SHARE * limits.features))

    def find(self, frame: StereoFrame, T_last: Array, T_predicted: Array, exposure: Exposure) -> PoseEstimate | None:
        """Return the best estimate from guesses of the pose, or the first good one; None: no landmarks were found.

        The guesses: the prediction, which nearly always is near; the prediction, searched with a pyramid; there, the
        peak of the circular correlation with the last panorama, over yaw, that keeps most landmarks (IV.F).
        """
        best: PoseEstimate | None = None
        for number in range(3):
            is_near = number == 0
            T_guess = T_predicted if number < 2 else self._turned(frame, T_last, T_predicted)
            estimate = self.estimate(frame, T_guess, exposure, is_near=is_near)
            if estimate is not None and (best is None or estimate.inliers > best.inliers):
                best = estimate
            if is_good_enough(best, self._limits, is_near=is_near):
                break
        return best

    def _turned(self, frame: StereoFrame, T_last: Array, T_predicted: Array) -> Array:
        """Return the predicted position, turned from the last pose by the yaw that keeps most landmarks (IV.F)."""
        assert self._map.last is not None
        before, now = self._map.last.panorama, frame.lower.panorama
        guesses = [
            se3.transform(T_last[:3, :3] @ se3.rotation_exp([0, 0, yaw_rad]), T_predicted[:3, 3])
            for yaw_rad in correlation_peaks(before, now, frame.usable, period_px=frame.lower.period_px)
        ]
        tracks = [self._map.track(frame.lower, T_guess, max_count=LANDMARKS) for T_guess in guesses]
        return guesses[int(np.argmax([len(each.landmarks) / max(1, each.visible) for each in tracks]))]

    def others(
        self, frame: StereoFrame, found: PoseEstimate, T_predicted: Array, exposure: Exposure, reach_m: float
    ) -> list[PoseEstimate]:
        """Return estimates of other motions within reach_m of the prediction: see motion_hypotheses.py."""
        # Displacements within reach from which the scene has the same appearance, and the poses to which they lead.
        off_m = found.distance_m(T_predicted)
        peaks = displacements(self._map, self._model, frame.lower, found.T_odom_rect, reach_m + off_m)
        is_good = is_good_enough(found, self._limits, is_near=False)
        others = [
            self.estimate(frame, _moved(found, *peak), exposure, is_near=True)
            for peak in peaks
            if peak.any() or not is_good
        ]
        return [each for each in others if each is not None and each.distance_m(T_predicted) < max(reach_m, off_m)]

    def estimate(self, frame: StereoFrame, T_guess: Array, exposure: Exposure, *, is_near: bool) -> PoseEstimate | None:
        """Return the pose from one guess (4, 4); None where fewer than MIN_LANDMARKS support it.

        Tracks from the last panorama and patches of the keyframes are two independent supports of the pose: the number
        of inliers is the smaller one of both.
        """
        # 1. Track the landmarks of the last panorama by KLT, forward and backward (section IV.A).
        tracks = self._map.track(frame.lower, T_guess, self._tracked, phase=frame.seq, near=is_near)
        if len(tracks.landmarks) < MIN_LANDMARKS:
            return None
        T_guess_odom = se3.inverse(T_guess)
        in_guess = se3.apply(T_guess_odom, self._map.table.points[tracks.landmarks])
        slopes = self._map.slopes(T_guess, tracks.landmarks)
        shift = exposure.shift(in_guess)
        # 2. The rows in the upper panorama, where the patches must fit within REACH_PX of where the depths put them; a
        #    wrong one is an outlier of the pose.
        guess = tracks.pixels + shift.px[:, :2] - shift.px[:, [3, 2]]
        guess[:, 1] += tracks.predicted[:, 2] - tracks.predicted[:, 1]
        pair = frame.lower, frame.upper
        rows, variance = align_rows(pair, tracks.pixels, guess, slopes, self._model, REACH_PX, shift.spread_px)
        views = np.column_stack([tracks.pixels, rows]) + shift.px[:, :3]
        # 3. RANSAC on three points (IV.B) and Gauss-Newton on the bearings in both cameras (IV.C, in place of eq. 9).
        T_curr_guess, is_inlier = ransac(in_guess, views, self._model, np.random.default_rng(frame.seq))
        chosen, noise = np.flatnonzero(is_inlier), shift.noise
        landmarks, coarse = tracks.landmarks[chosen], replace(self._model, sigma_px=COARSE_SIGMA_PX)
        solution, kept = self._solve(landmarks, views[chosen], T_curr_guess @ T_guess_odom, coarse, noise[chosen])
        if solution is None:
            return None
        # 4. Align the keyframes' patches, warped to the estimated viewpoint; Gauss-Newton again.
        chosen, landmarks = chosen[kept], landmarks[kept]
        disparity, variances = np.full(len(self._map), np.nan), np.zeros(len(self._map))
        disparity[landmarks], variances[landmarks] = (rows - tracks.pixels[:, 1])[chosen], variance[chosen]
        estimate = self.refine(frame, solution.T, exposure, disparity, variances)
        if estimate is None:
            return None
        visible, tracked, supporting = (
            round(tracks.each_counts * n) for n in (tracks.visible, len(tracks.landmarks), len(landmarks))
        )
        # The share that the upper camera confirms. Where the cameras expose at several times it is 1: an acceleration
        # that is not known hides rows as well.
        upper_ratio = float(np.isfinite(rows[chosen]).mean()) if frame.times.is_synchronised else 1.0
        return replace(
            estimate,
            visible=visible,
            tracked=tracked,
            inliers=min(supporting, estimate.inliers),
            rejected=tracks.pixels[~np.isin(tracks.landmarks, estimate.landmarks)],
            upper_ratio=upper_ratio,
        )

    def refine(
        self, frame: StereoFrame, T_curr_odom: Array, exposure: Exposure, disparity: Array, variance: Array
    ) -> PoseEstimate | None:
        """Return the pose from the keyframes' patches of all landmarks in view; None where too few are aligned.

        disparity, variance (N,) of the map's landmarks [px, px^2]: measured between the images of this frame, so that
        they go along with the aligned lower row; NaN: unknown.
        """
        # 1. Align the patches of the keyframes in the lower panorama.
        T_odom_curr = se3.inverse(T_curr_odom)
        landmarks, predicted = self._map.visible(T_odom_curr)
        in_view = len(landmarks)
        shift = exposure.shift(se3.apply(T_curr_odom, self._map.table.points[landmarks]))
        aligned = self._map.align(frame.lower, T_odom_curr, landmarks, predicted[:, :2] - shift.px[:, :2])
        found = aligned.found
        landmarks, pixels = landmarks[found], aligned.pixels[found]
        # 2. The views: aligned pixels, with the disparities of the tracks, corrected to the stamp of the pair.
        views = np.column_stack([pixels, pixels[:, 1] + disparity[landmarks]])
        noise = view_noise(aligned.covariance[found], variance[landmarks])
        views += shift.px[found, :3]
        # 3. Solve for the pose and the velocity. The prior of the velocity is one measurement: unlike the landmarks'
        #    errors it is not correlated with others.
        by_motion = shift.by_motion[found, :3]
        shared = by_motion, exposure.motion.covariance / CORRELATED
        solution, kept = self._solve(landmarks, views, T_curr_odom, self._model, noise, shared)
        if solution is None:
            return None
        # 4. The mean cost of a landmark in view; an outlier costs what the last inlier does.
        costs = float(cost(solution.squared[kept]).sum()) + (in_view - int(kept.sum())) * OUTLIER_COST
        # 5. The motion by which later frames correct depths is the one before this pair. The velocity found here agrees
        #    with the depths in the map, so it must not correct them: a vertical one has the effect of another baseline,
        #    and the scale would drift.
        landmarks = landmarks[kept]
        return PoseEstimate(
            se3.inverse(solution.T),
            CORRELATED * solution.covariance,
            in_view,
            int(found.sum()),
            len(landmarks),
            landmarks,
            views[kept],
            pixels[kept],
            variance[landmarks],
            solution.by_landmark[kept],
            by_motion=(by_motion[:, 2] - by_motion[:, 1])[kept],
            assumed=exposure.motion,
            cost=costs / max(1, in_view),
            in_view=in_view,
        )

    def refine_recognised(
        self, frame: StereoFrame, recognised: PoseEstimate, exposure: Exposure, reach_m: float
    ) -> PoseEstimate | None:
        """Return the pose of a frame that was recognised, by the keyframes' patches; None where too few agree.

        Corners and patches are two independent supports of the pose. Along identical bricks the corners may be those of
        others: so there is none, too, where the patches allow another pose within reach_m, from which the scene has the
        same appearance, see motion_hypotheses.py. Farther ones have another view, which makes patches fit worse.
        """
        found = self._aligned(frame, recognised.T_odom_rect, exposure)
        if found is None:
            return None
        peaks = displacements(self._map, self._model, frame.lower, found.T_odom_rect, reach_m)
        others = (self._aligned(frame, _moved(found, *peak), exposure) for peak in peaks if peak.any())
        allowed = likely([found, *(each for each in others if each is not None)])
        if any(each.distance_m(found.T_odom_rect) > SAME_M for each in allowed):
            return None
        inliers = min(recognised.inliers, found.inliers)
        return replace(found, visible=recognised.visible, tracked=recognised.tracked, inliers=inliers)

    def _aligned(self, frame: StereoFrame, T_odom_rect: Array, exposure: Exposure) -> PoseEstimate | None:
        """Return the pose by the patches of all landmarks from one that errs by centimetres; None: too few agree.

        The first refinement brings most patches into reach, the second one aligns them all.
        """
        unknown = np.full(len(self._map), np.nan), np.zeros(len(self._map))
        coarse = self.refine(frame, se3.inverse(T_odom_rect), exposure, *unknown)
        return coarse and self.refine(frame, se3.inverse(coarse.T_odom_rect), exposure, *unknown)

    def _solve(
        self,
        landmarks: Indices,
        views: Array,
        T_curr_odom: Array,
        model: StereoModel,
        noise: Array,
        shared: tuple[Array, Array] | None = None,
    ) -> tuple[GaussNewtonResult | None, Flags]:
        """Return the solution of Gauss-Newton, and flags (M,) of the inliers; None where they are too few."""
        if len(landmarks) < MIN_LANDMARKS:
            return None, np.zeros(len(landmarks), bool)
        points, covariance = self._map.table.points[landmarks], self._map.table.covariance[landmarks]
        solution = gauss_newton(points, covariance, views, T_curr_odom, model, noise, shared=shared)
        kept = solution.squared < OUTLIER_SQUARED
        return (solution if kept.sum() >= MIN_LANDMARKS else None), kept


def is_good_enough(estimate: PoseEstimate | None, limits: OdometryLimits, *, is_near: bool) -> bool:
    """True if no other guess is needed; is_near: it was found near a guess, without a pyramid."""
    return (
        estimate is not None
        and estimate.inliers >= GOOD_RATIO * is_near * estimate.visible
        and estimate.tracked >= GOOD_RATIO * estimate.visible
        and estimate.inlier_ratio >= limits.good_inlier_ratio
        and estimate.inliers >= limits.good_inliers
    )


def _moved(found: PoseEstimate, x_m: float, y_m: float) -> Array:
    """Return a pose (4, 4) moved along its own axes."""
    return found.T_odom_rect @ se3.exp([x_m, y_m, 0.0, 0.0, 0.0, 0.0])
