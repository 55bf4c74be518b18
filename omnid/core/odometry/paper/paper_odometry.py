"""Ego-motion of Dang et al. 2012, section IV and figure 5, as published: frame to frame, 3-D to 3-D.

It is selected by `--method paper`, so that the paper's experiments can be made again (`python -m tests.bench.paper`),
and a measure for the default method. Its known weaknesses: eq. (9) weights far points as much as near ones, depth noise
enters both of its sides, and an error between two frames is never corrected later.
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
from omnid.core.odometry.pose_estimation import consensus, rigid_fit
from omnid.core.odometry.pose_search import MIN_LANDMARKS
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import STEP_RAD, KltSettings, flow, track
from omnid.core.stereo.triangulation import triangulate, view
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FEATURES = OdometryLimits().features  # so that the methods are compared with as many
# Share of the features that makes a yaw hypothesis good enough ("N is more than needed", section IV.F). Beyond the
# ample share the search ends; between the two the next larger turn is tried as long as it finds more.
ENOUGH_RATIO = 0.5
AMPLE_RATIO = 0.85
THRESHOLD_M = 0.05  # largest 3-D error of a point of the consensus set, as in section IV.B
# Spectral density of the jerk, (m/s^3)^2/Hz and (rad/s^3)^2/Hz. The turns of section IV.F change the yaw rate by
# radians per second within 0.1 s; a filter that takes this for impossible would shorten the turn and overshoot.
JERK_PSD = (10.0, 4000.0)


@dataclass(frozen=True, slots=True)
class Registration:
    """Motion M (4, 4) of the points, b = M a, and its covariance (6, 6) [t; r] on the left of M."""

    M: Array
    covariance: Array


class PaperOdometry:
    """Estimate the pose of the rectified frame from pair to pair; odom is the rectified frame of the first pair."""

    def __init__(self, model: StereoModel, klt: KltSettings, tracker: str = "improved") -> None:
        """tracker: 'improved' rotates the image until enough features are tracked (section IV.F), 'klt' does not."""
        self._model, self._klt, self._tracker = model, klt, tracker
        self._filter = MotionFilter(JERK_PSD)
        self._T_odom_rect, self._covariance = np.eye(4), np.zeros((6, 6))
        self._previous: StereoFrame | None = None
        self._untracked_s = 0.0  # time since the last tracked pose
        self._resets = 0  # gaps after which tracking went on

    def complete(self) -> None:
        """Do nothing: `process` leaves nothing to do."""

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, dt_s [s] after the previous one (0 for the first): the steps of figure 5."""
        previous, self._previous = self._previous, frame
        if previous is None:
            return self._result(TrackingState.TRACKING, 0, 0)

        # 1. Detect features, track them into the current frame and locate them in both frames (section IV.A).
        F_a = corners(previous.lower, previous.usable, FEATURES)
        if self._tracker == "improved":
            F_b, tracked = turned_track(previous, frame, F_a, self._klt)
        else:
            F_b, tracked = flow(previous.lower, frame.lower, F_a, F_a, self._klt)
        X_a, X_b = locate(previous, F_a[tracked], self._model), locate(frame, F_b[tracked], self._model)
        located = np.isfinite(X_a).all(axis=1) & np.isfinite(X_b).all(axis=1)
        X_a, X_b = X_a[located], X_b[located]

        # 2. Eliminate outliers by RANSAC on three points (section IV.B).
        def agree(motions: Array) -> Flags:
            return np.asarray(np.linalg.norm(se3.apply(motions, X_a) - X_b, axis=-1) < THRESHOLD_M)

        _, is_inlier = consensus(X_a, X_b, agree, np.random.default_rng(frame.seq))
        inliers = int(is_inlier.sum())
        if inliers < MIN_LANDMARKS:
            return self._refuse(dt_s, len(X_a), inliers)

        # 3. Estimate the motion of the points (section IV.C, eq. 9), and refine it by KLT, started where it predicts
        #    the features.
        motion = register(X_a[is_inlier], X_b[is_inlier])
        motion = refine(previous, frame, F_a, motion, self._model, self._klt)

        # 4. Filter the motion (section IV.D) and compose its inverse, the motion of the camera (eq. 12). The
        #    measurement is the twist where eq. (11) has Euler angles: both agree for small motions, and for large ones
        #    only the twist is proportional to time.
        T_prev_curr, A = se3.inverse(motion.M), se3.adjoint(motion.M)
        self._covariance = A @ self._covariance @ A.T + motion.covariance
        if dt_s > 0:
            self._filter.predict(dt_s)
            T_prev_curr = self._filter.update(T_prev_curr, motion.covariance, dt_s)
        self._T_odom_rect = self._T_odom_rect @ T_prev_curr
        # The motion in a gap is not known: odom goes on from another place.
        state = TrackingState.DEGRADED if self._untracked_s else TrackingState.TRACKING
        self._resets, self._untracked_s = self._resets + bool(self._untracked_s), 0.0
        return self._result(state, len(X_a), inliers)

    def _refuse(self, dt_s: float, tracked: int, inliers: int) -> OdometryEstimate:
        """Keep the pose: the paper does not treat this case.

        Its covariance grows as under an unknown steady velocity.
        """
        self._filter.reset()
        before_s, self._untracked_s = self._untracked_s, self._untracked_s + dt_s
        growth = UNKNOWN_SPEED_SIGMA**2 * (self._untracked_s**2 - before_s**2)
        self._covariance = bounded(self._covariance + growth * np.eye(6))
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


def locate(frame: StereoFrame, features: Array, model: StereoModel) -> Array:
    """Return 3-D points (N, 3) in the rectified frame of features (N, 2), by the located point next to each: eq. (8).

    NaN where no located point is near.
    """
    disparity = nearby_disparity(frame.disparity, features)
    views = np.column_stack([features, features[:, 1] + disparity])
    return triangulate(views, model.cylinder, model.baseline_m)


def register(a: Array, b: Array) -> Registration:
    """Return the motion that minimises sum |b - M a|^2 over points (N, 3), N > 2: eq. (9).

    The paper finds the minimum by Gauss-Newton, here it has a closed form. The covariance is estimated from the
    residuals (White 1980), so it includes that far points are noisier, which eq. (9) ignores; it excludes the bias.
    """
    M = rigid_fit(a, b)
    moved = se3.apply(M, a)
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(b), 3, 3)), -se3.hat(moved)], axis=2)
    slopes = (np.swapaxes(J, 1, 2) @ (b - moved)[:, :, None])[:, :, 0]
    H = np.linalg.pinv(np.einsum("nij,nik->jk", J, J))
    freedom = len(b) / max(1, len(b) - 2)  # six unknowns use up the errors of two points
    return Registration(M, freedom * H @ (slopes.T @ slopes) @ H)


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
    return register(X_a[is_inlier], X_b[is_inlier])


def steps() -> list[float]:
    """Return the paper's yaw hypotheses [rad] in order of magnitude: 0, 18, -18, 36, -36, ... 162, -162, 180 degrees.

    The paper counts from 0 to 342 degrees, and so tries a small turn to the right last.
    """
    both = [sign * k * STEP_RAD for k in range(1, 10) for sign in (1, -1)]
    return [0.0, *both, 10 * STEP_RAD]


def turned_track(
    previous: StereoFrame, frame: StereoFrame, features: Array, klt: KltSettings, turns: Sequence[float] | None = None
) -> tuple[Array, Flags]:
    """Track features (N, 2) with the improved KLT of section IV.F: rotate image k+1 until enough of them are found.

    turns [rad]: the hypotheses in the order in which they are tried; None: those of the paper.

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
