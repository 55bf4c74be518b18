"""The ego-motion of Dang et al. 2012, section IV, as it stands: frame to frame, 3-D to 3-D.

Kept to be measured against: eq. (9) believes far points as much as near ones, their depth noise stands on both of its
sides, and what one pair of frames gets wrong stays wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import corners, nearby_disparity
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.odometry import OdometryEstimate
from omnid.core.odometry.paper.registration import Registration, consensus, register
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings, flow, track
from omnid.core.odometry.yaw_search import steps
from omnid.core.stereo.triangulation import triangulate
from omnid.errors import OmnidError
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

TRACKERS = ("improved", "klt")
REFERENCES = ("previous", "keyframe")
FEATURES = 500
ENOUGH = 0.5  # share of the features that must be found for a turn to be nearly right ("N is more than needed")
AMPLE = 0.85  # share that ends the search; between the two the next turn is tried, for as long as it finds more
EPSILON_PX = 3  # eq. (8): how far a located point may be from a feature that it locates
THRESHOLD_M = 0.05  # section IV.B: how far a point of the consensus may be from where the motion puts it
LEAST = 6  # points of the consensus, below which the motion is refused
WORN = 0.5  # share of a keyframe's best consensus, below which the present sight takes its place
# For the motion filter: the turns of section IV.F change the yaw rate by radians per second within a tenth of one, and
# a filter that calls this impossible would bend the turn and swing after it.
JERK_PSD = (10.0, 4000.0)
BLIND_SPEED = 0.5  # what may have happened where it is [m/s and rad/s], one deviation


@dataclass(frozen=True, slots=True)
class Reference:
    """The sight that motions are measured against, with its pose and covariance."""

    frame: StereoFrame
    T_odom_rect: Array
    covariance: Array


class PaperOdometry:
    """Follows the rectified frame from each sight to the next; odom is that frame at the first one.

    tracker: 'improved' turns the image until enough features are found (section IV.F), 'klt' does not. reference:
    'previous' measures against the sight before, as the paper does; 'keyframe' against one that is kept as long as
    half of its points agree, to tell what keyframes alone are worth.
    """

    def __init__(
        self, model: StereoModel, klt: KltSettings, tracker: str = "improved", reference: str = "previous"
    ) -> None:
        for name, found, known in (("tracker", tracker, TRACKERS), ("reference", reference, REFERENCES)):
            if found not in known:
                raise OmnidError(f"{name}: expected one of {', '.join(known)}, found {found!r}")
        self._model, self._klt, self._tracker = model, klt, tracker
        self._keeps = reference == "keyframe"
        self._filter = MotionFilter(JERK_PSD)
        self._T, self._covariance = np.eye(4), np.zeros((6, 6))
        self._reference: Reference | None = None
        self._most_inliers = 0

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """The pose at a sight, dt_s after the one before (0 for the first)."""
        reference = self._reference
        if reference is None:
            self._refer_to(frame)
            return self._ego(TrackingState.TRACKING, 0, 0)
        Ma, Mb = self._located(reference.frame, frame)
        M, agree = consensus(Ma, Mb, np.random.default_rng(frame.seq), THRESHOLD_M)
        inliers = int(agree.sum())
        if inliers < LEAST:
            ego = self._refuse(dt_s, len(Ma), inliers)
            self._refer_to(frame)
            return ego
        self._move(reference, register(Ma[agree], Mb[agree], M), dt_s)
        self._most_inliers = max(self._most_inliers, inliers)
        if not self._keeps or inliers < WORN * self._most_inliers:
            self._refer_to(frame)
        return self._ego(TrackingState.TRACKING, len(Ma), inliers)

    def _refer_to(self, frame: StereoFrame) -> None:
        """From now on measures against a sight whose pose is the present one."""
        self._reference = Reference(frame, self._T, self._covariance)
        self._most_inliers = 0

    def _located(self, previous: StereoFrame, frame: StereoFrame) -> tuple[Array, Array]:
        """Ma, Mb (N, 3): the same features before and now, those that SAD has located in both sights (section IV.A)."""
        F_a = corners(previous.lower, previous.usable, FEATURES)
        F_b, found = self._tracked(previous, frame, F_a) if len(F_a) else (F_a, np.zeros(0, bool))
        if not found.any():
            return np.zeros((0, 3)), np.zeros((0, 3))
        Ma, Mb = self._points(previous, F_a[found]), self._points(frame, F_b[found])
        both = np.isfinite(Ma).all(axis=1) & np.isfinite(Mb).all(axis=1)
        return Ma[both], Mb[both]

    def _tracked(self, previous: StereoFrame, frame: StereoFrame, F_a: Array) -> tuple[Array, Flags]:
        """F_b (N, 2) and which were found; plain KLT takes Lucas and Kanade's word for it."""
        if self._tracker == "klt":
            return flow(previous.lower, frame.lower, F_a, F_a, self._klt)
        return turned_track(previous, frame, F_a, self._klt)

    def _points(self, frame: StereoFrame, features: Array) -> Array:
        """3-D points (N, 3) in the rectified frame of features (N, 2), NaN where no located point is near: eq. (8)."""
        disparity = nearby_disparity(frame.disparity, features, EPSILON_PX)
        views = np.column_stack([features, features[:, 1] + disparity])
        return triangulate(views, self._model.cylinder, self._model.baseline_m)

    def _move(self, reference: Reference, found: Registration, dt_s: float) -> None:
        """Filters the motion (section IV.D) and composes the inverse of what the points did: eq. (12).

        The filter hears the fit's own covariance. It takes the twist where eq. (11) has Euler angles: the same for
        small motions, and for large ones the only thing that is proportional to time.
        """
        T_ref_curr = se3.inverse(found.M)
        T_prev_curr = se3.inverse(self._T) @ reference.T_odom_rect @ T_ref_curr
        if dt_s > 0:
            self._filter.predict(dt_s)
            T_prev_curr = self._filter.update(T_prev_curr, found.covariance, dt_s)
        self._T = self._T @ T_prev_curr
        self._covariance = _carried(reference.covariance, T_ref_curr) + found.covariance

    def _refuse(self, dt_s: float, located: int, inliers: int) -> OdometryEstimate:
        """Stays where it was: the paper has nothing for this."""
        self._filter.reset()
        self._covariance = self._covariance + (BLIND_SPEED * dt_s) ** 2 * np.eye(6)
        return self._ego(TrackingState.LOST, located, inliers)

    def _ego(self, state: TrackingState, tracked: int, inliers: int) -> OdometryEstimate:
        return OdometryEstimate(
            self._T,
            self._covariance,
            self._filter.velocity,
            self._filter.velocity_covariance,
            state,
            0,
            tracked,
            inliers,
        )


def _carried(covariance: Array, T_a_b: Array) -> Array:
    """Covariance (6, 6) of a pose, given in its own axes a, in the axes of b that is rigidly joined to it."""
    A = se3.adjoint(se3.inverse(T_a_b))
    return np.asarray(A @ covariance @ A.T)


def turned_track(
    previous: StereoFrame, frame: StereoFrame, features: Array, klt: KltSettings, turns: Sequence[float] | None = None
) -> tuple[Array, Flags]:
    """Track features (N, 2) with the improved KLT of section IV.F: rotate image k+1 until enough of them are found.

    turns [rad]: the hypotheses in the order in which they are tried; by default 0, 18, -18, 36, -36, ... degrees.

    The paper stops at the first turn that will do; but half a step away half of the features may be found as well, so
    the search goes on while the next larger turn, to the left or to the right, finds more. If no turn finds enough,
    the one that finds most is taken.

    On a panorama a turn of image k+1 is a shift of its columns, and to start the search that much further along is
    the same; the columns returned are those of k+1 itself, so the motion estimated from them is the total one. The
    paper counts what Lucas and Kanade report; but their status says only that the search ended, and four of five points
    are then wrong after 18 degrees. Only features that pass the forward-backward check are counted here.
    """
    best, most = (features, np.zeros(len(features), bool)), -1
    for _, both_directions in groupby(steps() if turns is None else turns, key=abs):
        before = most
        for turn in both_directions:
            shift = turn * previous.lower.width / (2 * np.pi)
            there, found = track(previous.lower, frame.lower, features, features + np.array([shift, 0.0]), klt)
            if found.sum() > most:
                best, most = (there, found), int(found.sum())
            if most >= AMPLE * len(features):
                return best
        if most == before and most >= ENOUGH * len(features):
            break
    return best
