"""The robot's own motion, sight by sight: guess, fit, believe or refuse, and keep the local map fresh."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import clear_around, corners, nearby_disparity, rows_in_upper
from omnid.core.odometry.landmarks import Keyframe, LocalMap
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.patch_alignment import disparity_slopes
from omnid.core.odometry.pose_estimate import PoseEstimate
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.pose_search import PoseSearch
from omnid.core.odometry.static_mask import StaticMask
from omnid.core.odometry.stereo_frame import Features, StereoFrame
from omnid.core.odometry.tracking import KltSettings, PaddedPanorama
from omnid.core.places.relocalisation import Relocaliser
from omnid.settings import knob
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

SLOWING_S = 0.3  # time constant of the velocity that is still believed when nothing is seen
BLIND_SPEED = 0.5  # what may have happened meanwhile [m/s and rad/s], one deviation


@dataclass(frozen=True, slots=True)
class OdometryLimits:
    """What is enough: features wanted, and the support below which a pose is doubted or refused."""

    features: int = knob(500, "landmarks wanted in a keyframe", low=20, high=10_000)
    refresh: float = knob(0.9, "a keyframe is added when this share of the last one's landmarks is left", low=0, high=1)
    sparse_every: int = knob(
        5, "sights after which a keyframe is added where the features wanted are not reached", low=1, high=1000
    )
    keyframes: int = knob(8, "keyframes in the local map; 1: frame to frame", low=1, high=50)
    min_inliers: int = knob(20, "landmarks that must agree with a pose", low=4, high=10_000)
    min_share: float = knob(0.4, "share of the found landmarks that must agree", low=0, high=1)
    sure_inliers: int = knob(50, "below so many the pose is degraded", low=4, high=10_000)
    sure_share: float = knob(0.6, "below this share other turns are tried", low=0, high=1)
    max_speed_mps: float = knob(5.0, "faster the robot cannot be, m/s", low=0.1, high=100)
    lost_after: int = knob(3, "refused poses running that make the state lost", low=1, high=1000)
    restart_after: int = knob(
        10, "sights with enough corners that fit nowhere, before the map starts anew", low=1, high=10_000
    )
    max_gap_s: float = knob(0.5, "a pose after a longer silence is degraded, s", low=0.01, high=60)


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """The pose after a sight, T_odom_rect, and how good it is; covariances in the rectified frame, [t; r]."""

    T_odom_rect: Array
    covariance: Array  # (6, 6) m^2, rad^2
    velocity: Array  # (6,) m/s, rad/s
    velocity_covariance: Array
    state: TrackingState
    resets: int
    tracked: int
    inliers: int
    features: Features = field(default_factory=Features)


class VisualOdometry:
    """Follows the rectified frame through sights; odom is that frame at the first one."""

    def __init__(self, model: StereoModel, klt: KltSettings, limits: OdometryLimits) -> None:
        self._limits = limits
        self._stereo_klt = KltSettings(klt.window_px, 1, klt.max_error_px, klt.iterations)
        self._map = LocalMap(model, klt, limits.keyframes)
        self._search = PoseSearch(self._map, model, klt)
        self._filter = MotionFilter()
        self._pattern = StaticMask()
        self._relocaliser = Relocaliser(model)
        self._T, self._covariance = np.eye(4), np.zeros((6, 6))
        self._previous: PaddedPanorama | None = None
        self._refused = self._unmatched_frames = self._resets = 0
        self._time_since_fix_s = 0.0
        self._most_inliers = 0  # landmarks, since the last keyframe: what this place can give
        self._since_keyframe = 0

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """The pose at a sight, dt_s after the one before (0 for the first)."""
        usable = self._pattern.without(frame.usable)
        dt_s = max(dt_s, 0.0)
        if self._previous is None:
            return self._begin(frame, usable, dt_s)
        expected = self._T @ self._filter.predict(min(dt_s, self._limits.max_gap_s))
        fit = self._locate((frame, usable), self._previous, expected, dt_s)
        return self._refuse(frame, usable, expected, dt_s) if fit is None else self._accept(frame, usable, fit, dt_s)

    def _begin(self, frame: StereoFrame, usable: Flags, dt_s: float) -> OdometryEstimate:
        """Starts, or starts again, a map at the present pose if the sight has enough corners."""
        new = self._add_keyframe(frame, usable, np.zeros((0, 2)))
        if len(self._map) < self._limits.min_inliers:
            self._map.clear()
            self._doubt(dt_s)
            return self._ego(TrackingState.LOST, 0, 0)
        self._previous, self._refused, self._unmatched_frames, self._time_since_fix_s = frame.lower, 0, 0, 0.0
        return self._ego(TrackingState.TRACKING, len(self._map), len(self._map), Features(new=new))

    def _locate(
        self, seen: tuple[StereoFrame, Flags], previous: PaddedPanorama, expected: Array, dt_s: float
    ) -> PoseEstimate | None:
        """The best supported pose of all guesses: as expected; in doubt, after a turn; after a break, at a keyframe.

        In the dark nothing is searched: once a pose was refused, a image without corners is not worth it.
        """
        frame, usable = seen
        if self._refused and not self._is_textured(frame, usable):
            return None
        fit = self._search.from_guess(frame, expected)
        if not self._convincing(fit):
            guess = self._search.best_turn(frame, previous, (self._T, expected), usable)
            fit = _better(fit, self._search.from_guess(frame, guess))
        if not self._believable(fit, dt_s) and (self._refused or dt_s > self._limits.max_gap_s):
            fit = self._relocaliser.locate(frame)
        return fit if self._believable(fit, dt_s) else None

    def _convincing(self, fit: PoseEstimate | None) -> bool:
        limits = self._limits
        return (fit is not None and fit.tracked >= fit.visible / 2 and fit.share >= limits.sure_share
                and fit.inliers >= limits.sure_inliers)

    def _believable(self, fit: PoseEstimate | None, dt_s: float) -> bool:
        """Whether enough landmarks agree, and the robot would not have to fly."""
        if fit is None or fit.inliers < self._limits.min_inliers or fit.share < self._limits.min_share:
            return False
        moved = float(np.linalg.norm(fit.T_odom_rect[:3, 3] - self._T[:3, 3]))
        return moved <= self._limits.max_speed_mps * (max(dt_s, 0.05) + self._time_since_fix_s)

    def _accept(self, frame: StereoFrame, usable: Flags, fit: PoseEstimate, dt_s: float) -> OdometryEstimate:
        """Takes the pose over."""
        doubtful = self._refused > 0 or dt_s > self._limits.max_gap_s or fit.inliers < self._limits.sure_inliers
        if self._refused or not 0 < dt_s <= self._limits.max_gap_s:
            self._filter.reset()
        else:
            self._filter.update(se3.inverse(self._T) @ fit.T_odom_rect, fit.covariance, dt_s)
        self._covariance = fit.covariance + (self._inherited(fit) if len(fit.landmarks) else 0.0)
        self._T, self._previous = fit.T_odom_rect, frame.lower
        self._refused = self._unmatched_frames = 0
        self._time_since_fix_s = 0.0
        self._pattern.observe(frame.lower.panorama, self._T)
        features = Features(fit.pixels, fit.rejected, self._refresh_map(frame, usable, fit))
        return self._ego(
            TrackingState.DEGRADED if doubtful else TrackingState.TRACKING, fit.tracked, fit.inliers, features
        )

    def _refuse(self, frame: StereoFrame, usable: Flags, expected: Array, dt_s: float) -> OdometryEstimate:
        """Goes on as expected, slowing down, with a covariance that grows; starts anew when nothing helps."""
        self._refused += 1
        A = se3.adjoint(se3.inverse(expected) @ self._T)
        self._T, self._covariance = expected, A @ self._covariance @ A.T
        self._filter.slow_down(math.exp(-dt_s / SLOWING_S))
        self._doubt(dt_s)
        lost = self._refused >= self._limits.lost_after
        if lost and self._is_textured(frame, usable):
            self._unmatched_frames += 1
        if self._unmatched_frames >= self._limits.restart_after:
            return self._restart(frame, usable, dt_s)
        return self._ego(TrackingState.LOST if lost else TrackingState.DEGRADED, 0, 0)

    def _doubt(self, dt_s: float) -> None:
        """Lets the covariance grow by what may have happened unseen, as an unknown but steady motion does."""
        before, self._time_since_fix_s = self._time_since_fix_s, self._time_since_fix_s + dt_s
        self._covariance = self._covariance + BLIND_SPEED**2 * (self._time_since_fix_s**2 - before**2) * np.eye(6)

    def _restart(self, frame: StereoFrame, usable: Flags, dt_s: float) -> OdometryEstimate:
        """A new map from here on: the gap stays in the covariance, and the reset counter says so."""
        self._map.clear()
        self._previous = None
        self._relocaliser.forget()
        self._filter.reset()
        self._resets += 1
        return self._begin(frame, usable, dt_s)

    def _is_textured(self, frame: StereoFrame, usable: Flags) -> bool:
        return len(corners(frame.lower, usable, 4 * self._limits.min_inliers)) >= 2 * self._limits.min_inliers

    def _refresh_map(self, frame: StereoFrame, usable: Flags, fit: PoseEstimate) -> Array:
        """Forgets landmarks that stay away, and adds a keyframe where too few are left; the pixels of new landmarks."""
        self._map.saw(frame.lower, fit.landmarks, fit.pixels)
        inliers, limits = len(fit.landmarks), self._limits
        if limits.keyframes == 1:  # frame to frame: all landmarks are new, for those of before go with their keyframe
            return self._add_keyframe(frame, usable, np.zeros((0, 2)))
        self._most_inliers = max(self._most_inliers, inliers)
        self._since_keyframe += 1
        sparse = inliers < limits.refresh * limits.features and self._since_keyframe >= limits.sparse_every
        if sparse or inliers < limits.refresh * self._most_inliers or inliers < limits.sure_inliers:
            return self._add_keyframe(frame, usable, fit.pixels)
        return np.zeros((0, 2))

    def _add_keyframe(self, frame: StereoFrame, usable: Flags, known: Array) -> Array:
        """Fills the gaps between known landmarks with new ones, located by SAD and refined by KLT; their pixels."""
        free = clear_around(usable, known, 9)
        points = corners(frame.lower, free, self._limits.features - len(known))
        guess = points[:, 1] + nearby_disparity(frame.disparity, points)
        rows = rows_in_upper((frame.lower, frame.upper), points, guess, self._stereo_klt)
        located = np.isfinite(rows)
        keyframe = Keyframe(frame.seq, frame.lower, self._T, self._covariance)
        slopes = disparity_slopes(frame.disparity, points[located], (rows - points[:, 1])[located])
        self._map.add(keyframe, np.column_stack([points, rows])[located], slopes)
        if len(self._map) >= self._limits.min_inliers:
            self._relocaliser.remember(frame, keyframe)
        self._most_inliers = self._since_keyframe = 0
        return points[located]

    def _inherited(self, fit: PoseEstimate) -> Array:
        """Covariance (6, 6) that comes with the keyframes in which the agreeing landmarks are anchored."""
        share = self._map.anchor_shares(fit.landmarks)
        A = {seq: se3.adjoint(se3.inverse(fit.T_odom_rect) @ self._map.keyframes[seq].T_odom_rect) for seq in share}
        parts = [s * A[seq] @ self._map.keyframes[seq].covariance @ A[seq].T for seq, s in share.items()]
        return np.asarray(sum(parts, np.zeros((6, 6))))

    def _ego(
        self, state: TrackingState, tracked: int, inliers: int, features: Features | None = None
    ) -> OdometryEstimate:
        return OdometryEstimate(
            self._T,
            self._covariance,
            self._filter.velocity,
            self._filter.velocity_covariance,
            state,
            self._resets,
            tracked,
            inliers,
            features or Features(),
        )


def _better(a: PoseEstimate | None, b: PoseEstimate | None) -> PoseEstimate | None:
    """The fit with more agreeing landmarks."""
    return max((fit for fit in (a, b) if fit), key=lambda fit: fit.inliers, default=None)
