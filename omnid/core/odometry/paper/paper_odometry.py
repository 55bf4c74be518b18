"""Ego-motion of Dang et al. 2012, section IV and figure 5, as published: frame to frame, 3-D to 3-D.

Kept for comparison with the default method. Its known weaknesses: eq. (9) weights far points as much as near ones,
depth noise enters both of its sides, and an error between two frames is never corrected later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import corners, nearby_disparity
from omnid.core.odometry.estimates import OdometryEstimate, OdometryLimits
from omnid.core.odometry.motion_filter import UNKNOWN_SPEED_SIGMA, MotionFilter, bounded
from omnid.core.odometry.paper.registration import Registration, consensus, register
from omnid.core.odometry.pose_search import MIN_LANDMARKS
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, flow, steps, track
from omnid.core.stereo.triangulation import triangulate, view
from omnid.core.types.stereo_model import StereoModel
from omnid.errors import OmnidError
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

TRACKERS = ("improved", "klt")
REFERENCES = ("previous", "keyframe")
FEATURES = OdometryLimits().features  # so that the methods are compared with as many
# Share of the features that makes a yaw hypothesis good enough ("N is more than needed", section IV.F). Beyond the
# ample share the search ends; between the two the next larger turn is tried as long as it finds more. A keyframe with
# less than it of its largest consensus set is replaced.
ENOUGH_RATIO = 0.5
AMPLE_RATIO = 0.85
THRESHOLD_M = 0.05  # largest 3-D error of a point of the consensus set, as in section IV.B
# Spectral density of the jerk, (m/s^3)^2/Hz and (rad/s^3)^2/Hz. The turns of section IV.F change the yaw rate by
# radians per second within 0.1 s; a filter that takes this for impossible would shorten the turn and overshoot.
JERK_PSD = (10.0, 4000.0)


@dataclass(frozen=True, slots=True)
class Reference:
    """The frame that motions are measured against, with its pose and the pose's covariance."""

    frame: StereoFrame
    T_odom_rect: Array
    covariance: Array


class PaperOdometry:
    """Estimate the pose of the rectified frame from pair to pair; odom is the rectified frame of the first pair.

    tracker: 'improved' rotates the image until enough features are tracked (section IV.F), 'klt' does not. reference:
    'previous' measures against the previous frame, as the paper does; 'keyframe' against a frame that is kept while
    half of its points are inliers, which shows the effect of keyframes alone.
    """

    def __init__(
        self, model: StereoModel, klt: KltSettings, tracker: str = "improved", reference: str = "previous"
    ) -> None:
        for name, found, known in (("tracker", tracker, TRACKERS), ("reference", reference, REFERENCES)):
            if found not in known:
                raise OmnidError(f"{name}: expected one of {', '.join(known)}, found {found!r}")
        self._model, self._klt, self._tracker = model, klt, tracker
        self._keeps_reference = reference == "keyframe"
        self._filter = MotionFilter(JERK_PSD)
        self._T_odom_rect, self._covariance = np.eye(4), np.zeros((6, 6))
        self._reference: Reference | None = None
        self._most_inliers = 0
        self._untracked_s = 0.0  # time since the last tracked pose
        self._resets = 0  # gaps after which tracking went on

    def complete(self) -> None:
        """Do nothing: `process` leaves nothing to do."""

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, dt_s [s] after the previous one (0 for the first): the steps of figure 5."""
        reference = self._reference
        if reference is None:
            self._set_reference(frame)
            return self._result(TrackingState.TRACKING, 0, 0)

        # 1. Detect features, track them into the current frame and locate them in both frames (section IV.A).
        F_a = corners(reference.frame.lower, reference.frame.usable, FEATURES)
        F_b, tracked = self._track(reference.frame, frame, F_a)
        X_a = locate(reference.frame, F_a[tracked], self._model)
        X_b = locate(frame, F_b[tracked], self._model)
        located = np.isfinite(X_a).all(axis=1) & np.isfinite(X_b).all(axis=1)
        X_a, X_b = X_a[located], X_b[located]

        # 2. Eliminate outliers by RANSAC on three points (section IV.B).
        M, is_inlier = consensus(X_a, X_b, np.random.default_rng(frame.seq), THRESHOLD_M)
        inliers = int(is_inlier.sum())
        if inliers < MIN_LANDMARKS:
            return self._refuse(frame, dt_s, len(X_a), inliers)

        # 3. Estimate the motion of the points by Gauss-Newton (section IV.C, eq. 9).
        motion = register(X_a[is_inlier], X_b[is_inlier], M)

        # 4. Refine the result by KLT, started where the estimated motion predicts the features.
        motion = refine(reference.frame, frame, F_a, motion, self._model, self._klt)

        # 5. Filter the motion (section IV.D) and compose its inverse, the motion of the camera (eq. 12).
        self._move(reference, motion, dt_s)
        self._most_inliers = max(self._most_inliers, inliers)
        if not self._keeps_reference or inliers < ENOUGH_RATIO * self._most_inliers:
            self._set_reference(frame)
        # The motion in a gap is not known: odom goes on from another place.
        state = TrackingState.DEGRADED if self._untracked_s else TrackingState.TRACKING
        self._resets, self._untracked_s = self._resets + bool(self._untracked_s), 0.0
        return self._result(state, len(X_a), inliers)

    def _set_reference(self, frame: StereoFrame) -> None:
        """Measure the following motions against a frame whose pose is the current one."""
        self._reference = Reference(frame, self._T_odom_rect, self._covariance)
        self._most_inliers = 0

    def _track(self, previous: StereoFrame, frame: StereoFrame, features: Array) -> tuple[Array, Flags]:
        """Return the pixels (N, 2) of features in a frame, and flags (N,) of those that were found."""
        if not len(features):
            return features, np.zeros(0, bool)
        if self._tracker == "klt":
            return flow(previous.lower, frame.lower, features, features, self._klt)
        return turned_track(previous, frame, features, self._klt)

    def _move(self, reference: Reference, motion: Registration, dt_s: float) -> None:
        """Filter the motion of the points and compose its inverse to the current pose.

        The measurement noise of the filter is the covariance of the registration. The measurement is the twist where
        eq. (11) has Euler angles: both agree for small motions, and for large ones only the twist is proportional to
        time.
        """
        T_ref_curr = se3.inverse(motion.M)
        T_prev_curr = se3.inverse(self._T_odom_rect) @ reference.T_odom_rect @ T_ref_curr
        if dt_s > 0:
            self._filter.predict(dt_s)
            T_prev_curr = self._filter.update(T_prev_curr, motion.covariance, dt_s)
        self._T_odom_rect = self._T_odom_rect @ T_prev_curr
        self._covariance = _moved_covariance(reference.covariance, T_ref_curr) + motion.covariance

    def _refuse(self, frame: StereoFrame, dt_s: float, tracked: int, inliers: int) -> OdometryEstimate:
        """Keep the pose: the paper does not treat this case.

        Its covariance grows as under an unknown steady velocity.
        """
        self._filter.reset()
        before_s, self._untracked_s = self._untracked_s, self._untracked_s + dt_s
        growth = UNKNOWN_SPEED_SIGMA**2 * (self._untracked_s**2 - before_s**2)
        self._covariance = bounded(self._covariance + growth * np.eye(6))
        self._set_reference(frame)
        return self._result(TrackingState.LOST, tracked, inliers)

    def _result(self, state: TrackingState, tracked: int, inliers: int) -> OdometryEstimate:
        return OdometryEstimate(
            self._T_odom_rect,
            self._covariance,
            self._filter.velocity,
            self._filter.velocity_covariance,
            state,
            self._resets,
            tracked,
            inliers,
        )


def _moved_covariance(covariance: Array, T_a_b: Array) -> Array:
    """Return the covariance (6, 6) of a pose, given in its own axes a, in axes b that are rigidly joined to it."""
    A = se3.adjoint(se3.inverse(T_a_b))
    return np.asarray(A @ covariance @ A.T)


def locate(frame: StereoFrame, features: Array, model: StereoModel) -> Array:
    """Return 3-D points (N, 3) in the rectified frame of features (N, 2), by the located point next to each: eq. (8).

    NaN where no located point is near.
    """
    disparity = nearby_disparity(frame.disparity, features)
    views = np.column_stack([features, features[:, 1] + disparity])
    return triangulate(views, model.cylinder, model.baseline_m)


def refine(
    previous: StereoFrame,
    current: StereoFrame,
    features: Array,
    motion: Registration,
    model: StereoModel,
    klt: KltSettings,
) -> Registration:
    """Return the motion between two frames estimated again from all located features (N, 2): figure 5, step 4.

    The paper names this step and does not describe it. Here KLT starts where the motion predicts each feature, so that
    features are found that the first search missed or tracked badly; those within THRESHOLD_M of the motion take part
    in eq. (9) once more. With fewer than MIN_LANDMARKS of them the motion is returned as it is.
    """
    X_a = locate(previous, features, model)
    known = np.isfinite(X_a).all(axis=1)
    features, X_a = features[known], X_a[known]
    predicted = view(se3.apply(motion.M, X_a), model.cylinder, model.baseline_m)[:, :2]
    pixels, found = track(previous.lower, current.lower, features, predicted, klt)
    X_a, X_b = X_a[found], locate(current, pixels[found], model)
    error_m = np.linalg.norm(se3.apply(motion.M, X_a) - X_b, axis=1)
    is_inlier = error_m < THRESHOLD_M  # false for NaN
    if is_inlier.sum() < MIN_LANDMARKS:
        return motion
    return register(X_a[is_inlier], X_b[is_inlier], motion.M)


def turned_track(
    previous: StereoFrame, frame: StereoFrame, features: Array, klt: KltSettings, turns: Sequence[float] | None = None
) -> tuple[Array, Flags]:
    """Track features (N, 2) with the improved KLT of section IV.F: rotate image k+1 until enough of them are found.

    turns [rad]: the hypotheses in the order in which they are tried; by default 0, 18, -18, 36, -36, ... degrees.

    The paper stops at the first turn that will do; but half a step away half of the features may be found as well, so
    the search goes on while the next larger turn, to the left or to the right, finds more. If no turn finds enough,
    the one that finds most is used.

    On a panorama a turn of image k+1 is a shift of its columns, and to start the search that much further along is
    the same; the columns returned are those of k+1 itself, so the motion estimated from them is the total one. The
    paper counts what Lucas and Kanade report; but their status says only that the search ended, and four of five points
    are then wrong after 18 degrees. Only features that pass the forward-backward check are counted here.
    """
    best, most = (features, np.zeros(len(features), bool)), -1
    for _, both_directions in groupby(steps() if turns is None else turns, key=abs):
        before = most
        for turn in both_directions:
            shift = turn * previous.lower.period_px / (2 * np.pi)
            there, found = track(previous.lower, frame.lower, features, features + np.array([shift, 0.0]), klt)
            if found.sum() > most:
                best, most = (there, found), int(found.sum())
            if most >= AMPLE_RATIO * len(features):
                return best
        if most == before and most >= ENOUGH_RATIO * len(features):
            break
    return best
