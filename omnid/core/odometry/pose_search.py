"""The search for the pose of a frame in the local map: guesses, each tracked, estimated and refined, and the runner-up.

Equations and sections are those of Dang et al. 2012.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryLimits, PoseEstimate, with_more_inliers
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.frame_exposures import FrameExposures
from omnid.core.odometry.frame_to_map import FrameToMap
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.runner_up_motions import displacements, likeliest
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import correlation_peaks, steps
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Share of the predicted landmarks, inliers, below which they are also searched with a pyramid, because without one, in
# noise, tracks stay near a wrong prediction and confirm it.
NEAR_RATIO = 0.5
# Share of the predicted landmarks, tracked, below which other yaw angles are tried.
GOOD_TRACKED_RATIO = 0.5
# Landmarks tracked from the last panorama at most, as a share of those wanted, others in the next frame: enough for the
# start of the refinement, which aligns the patches of all landmarks.
TRACKED_SHARE = 0.6


class LastFrame(NamedTuple):
    """The last accepted frame."""

    T_odom_rect: Array  # (4, 4)
    panorama: PaddedPanorama  # the lower one


class PoseSearch:
    """Finds a frame in the local map."""

    def __init__(
        self,
        local_map: LocalMap,
        model: StereoModel,
        limits: OdometryLimits,
        *,
        frame_to_map: FrameToMap,
        exposures: FrameExposures,
    ) -> None:
        self._map, self._model, self._limits = local_map, model, limits
        self._frame_to_map, self._exposures = frame_to_map, exposures

    @property
    def tracked(self) -> int:
        """Number of landmarks that are tracked at most."""
        return max(2 * self._limits.good_inliers, round(TRACKED_SHARE * self._limits.features))

    def find(
        self, frame: StereoFrame, usable: Flags, last: LastFrame, T_predicted: Array, dt_s: float
    ) -> PoseEstimate | None:
        """Return the best estimate from the guesses, or the first good one; None: no landmarks were found."""
        sensed_m = math.nan
        if frame.sensed is not None and frame.sensed.is_complete:
            sensed_m = float(np.linalg.norm(T_predicted[:3, 3] - last.T_odom_rect[:3, 3]))
        self._map.decide_first_depths(frame.lower, (self._limits.max_speed_mps * dt_s, sensed_m))
        best: PoseEstimate | None = None
        exposure = self._exposures.predicted(frame, dt_s)
        for T_guess, is_near in self._guesses(frame, usable, last, T_predicted):
            estimate = self._estimate(frame, T_guess, exposure, last, dt_s, is_near=is_near)
            best = with_more_inliers(best, estimate)
            if is_good_enough(best, self._limits, is_near=is_near):
                break
        return None if best is None else self._with_doubtful_depths(best)

    def with_runner_up(
        self,
        frame: StereoFrame,
        estimate: PoseEstimate,
        last: LastFrame,
        T_predicted: Array,
        dt_s: float,
        *,
        reach_m: float,
    ) -> PoseEstimate:
        """Return the likeliest pose within reach_m of the prediction, with its runner-up: runner_up_motions.py."""
        # 1. Displacements within reach from which the scene has the same appearance, and the poses to which they lead.
        off_m = estimate.distance_m(T_predicted)
        peaks = displacements(self._map, self._model, frame.lower, estimate.T_odom_rect, reach_m + off_m)
        exposure = self._exposures.predicted(frame, dt_s)
        is_good, others = is_good_enough(estimate, self._limits, is_near=False), []
        for x, y in peaks:
            if is_good and x == y == 0:
                continue
            T_guess = estimate.T_odom_rect @ se3.exp([x, y, 0.0, 0.0, 0.0, 0.0])
            other = self._estimate(frame, T_guess, exposure, last, dt_s, is_near=True)
            others += [other] if other is not None and other.distance_m(T_predicted) < reach_m else []
        # 2. Where many tracks are outliers, the pose by these: their depths may be right, and the inliers' wrong. The
        #    same where the inliers show no motion of a vehicle: they may be on a person who walks along, and what is
        #    nearer to the prediction is right.
        if estimate.inlier_ratio < self._limits.good_inlier_ratio or off_m > reach_m:
            other = self._by_outliers(frame, estimate, exposure, last, dt_s)
            others += [other] if other is not None else []
        # 3. The likeliest one, and whether another one is nearly as likely.
        return self._with_doubtful_depths(likeliest(estimate, others, T_predicted, max(reach_m, off_m)))

    def _with_doubtful_depths(self, estimate: PoseEstimate) -> PoseEstimate:
        """Return an estimate whose covariance covers other depths of the first keyframe: first_depths.py."""
        first = self._map.first_depths
        other = None if first is None or estimate.doubtful_depths else first.runner_up(estimate.T_odom_rect)
        if other is None:
            return estimate
        # Of landmarks with several depths a pose may also err to the side.
        covariance = estimate.covariance + np.diag(np.repeat([float(other[:3] @ other[:3]), 0.0], 3))
        return replace(estimate, covariance=covariance, doubtful_depths=True)

    def _by_outliers(
        self, frame: StereoFrame, estimate: PoseEstimate, exposure: Exposure, last: LastFrame, dt_s: float
    ) -> PoseEstimate | None:
        """Return the pose by the tracks that are outliers of an estimate; None: too few of them agree."""
        tracks = self._map.track(frame.lower, estimate.T_odom_rect, self.tracked, turn=frame.seq)
        outliers = tracks.without(estimate.landmarks)
        coarse = self._frame_to_map.estimate(frame, outliers, estimate.T_odom_rect, exposure)
        return None if coarse is None else self._exposures.refine(frame, coarse, exposure, last.T_odom_rect, dt_s)

    def _estimate(
        self, frame: StereoFrame, T_guess: Array, exposure: Exposure, last: LastFrame, dt_s: float, *, is_near: bool
    ) -> PoseEstimate | None:
        """Return the pose from one guess; None: no landmarks were found."""
        # 1. Track the landmarks of the last panorama by KLT, forward and backward (section IV.A).
        tracks = self._map.track(frame.lower, T_guess, self.tracked, turn=frame.seq, near=is_near)

        # 2. Estimate: find them in the upper panorama as well, then RANSAC on three points (IV.B) and Gauss-Newton on
        #    the bearings in both panoramas (IV.C, in place of eq. 9).
        coarse = self._frame_to_map.estimate(frame, tracks, T_guess, exposure)
        if coarse is None:
            return None

        # 3. Refine: align the keyframes' patches, warped to the estimated viewpoint; Gauss-Newton again.
        return self._exposures.refine(frame, coarse, exposure, last.T_odom_rect, dt_s)

    def _guesses(
        self, frame: StereoFrame, usable: Flags, last: LastFrame, T_predicted: Array
    ) -> Iterator[tuple[Array, bool]]:
        """Yield guesses of the pose, and whether they count as near: the prediction, which nearly always is near.

        Then, each if what was before was not good: the prediction, searched with a pyramid; the best yaw hypothesis
        there (IV.F). The hypotheses are the peaks of the circular correlation with the last panorama, then the paper's
        steps.
        """
        yield T_predicted, True
        yield T_predicted, False
        peaks = correlation_peaks(last.panorama.panorama, frame.lower.panorama, usable, turn_px=frame.lower.period_px)
        T_unturned = last.T_odom_rect.copy()
        T_unturned[:3, 3] = T_predicted[:3, 3]
        yield self._frame_to_map.best_yaw(frame, T_unturned, peaks + steps(), likely=len(peaks)), False


def is_good_enough(estimate: PoseEstimate | None, limits: OdometryLimits, *, is_near: bool) -> bool:
    """True if no other guess is needed; is_near: it was found near a guess, without a pyramid."""
    return (
        estimate is not None
        and estimate.inliers >= NEAR_RATIO * is_near * estimate.visible
        and estimate.tracked >= GOOD_TRACKED_RATIO * estimate.visible
        and estimate.inlier_ratio >= limits.good_inlier_ratio
        and estimate.inliers >= limits.good_inliers
    )
