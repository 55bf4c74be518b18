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
from omnid.core.odometry.pose_estimate import Fit
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.pose_search import PoseSearch
from omnid.core.odometry.static_mask import FixedPattern
from omnid.core.odometry.stereo_frame import Features, Sight
from omnid.core.odometry.tracking import Klt, Wrapped
from omnid.core.places.relocalisation import Relocaliser

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

TRACKING, DEGRADED, LOST = "tracking", "degraded", "lost"

SLOWING_S = 0.3  # time constant of the velocity that is still believed when nothing is seen
BLIND_SPEED = 0.5  # what may have happened meanwhile [m/s and rad/s], one deviation


@dataclass(frozen=True, slots=True)
class Limits:
    """What is enough: features wanted, and the support below which a pose is doubted or refused."""

    features: int = 500
    refresh: float = 0.9  # share of the most landmarks since the last keyframe, below which one is added
    sparse_every: int = 5  # sights after which a keyframe is added where the features wanted are not reached
    keyframes: int = 8
    min_inliers: int = 20
    min_share: float = 0.4
    sure_inliers: int = 50
    sure_share: float = 0.6
    max_speed_mps: float = 5.0
    lost_after: int = 3  # refused poses running
    restart_after: int = 10  # sights with enough corners that still fit nowhere
    max_gap_s: float = 0.5


@dataclass(frozen=True, slots=True)
class Ego:
    """The pose after a sight, T_odom_rect, and how good it is; covariances in the rectified frame, [t; r]."""

    T_odom_rect: Array
    covariance: Array  # (6, 6) m^2, rad^2
    velocity: Array  # (6,) m/s, rad/s
    velocity_covariance: Array
    state: str
    resets: int
    tracked: int
    agreeing: int
    features: Features = field(default_factory=Features)


class EgoMotion:
    """Follows the rectified frame through sights; odom is that frame at the first one."""

    def __init__(self, model: StereoModel, klt: Klt, limits: Limits) -> None:
        self._limits = limits
        self._stereo_klt = Klt(klt.window_px, 1, klt.max_error_px, klt.iterations)
        self._map = LocalMap(model, klt, limits.keyframes)
        self._search = PoseSearch(self._map, model, klt)
        self._filter = MotionFilter()
        self._pattern = FixedPattern()
        self._relocaliser = Relocaliser(model)
        self._T, self._covariance = np.eye(4), np.zeros((6, 6))
        self._previous: Wrapped | None = None
        self._refused = self._strange = self._resets = 0
        self._blind_s = 0.0
        self._most_agreeing = 0  # landmarks, since the last keyframe: what this place can give
        self._since_keyframe = 0

    def process(self, sight: Sight, dt_s: float) -> Ego:
        """The pose at a sight, dt_s after the one before (0 for the first)."""
        usable = self._pattern.without(sight.usable)
        dt_s = max(dt_s, 0.0)
        if self._previous is None:
            return self._begin(sight, usable, dt_s)
        expected = self._T @ self._filter.predict(min(dt_s, self._limits.max_gap_s))
        fit = self._locate((sight, usable), self._previous, expected, dt_s)
        return self._refuse(sight, usable, expected, dt_s) if fit is None else self._accept(sight, usable, fit, dt_s)

    def _begin(self, sight: Sight, usable: Flags, dt_s: float) -> Ego:
        """Starts, or starts again, a map at the present pose if the sight has enough corners."""
        new = self._add_keyframe(sight, usable, np.zeros((0, 2)))
        if len(self._map) < self._limits.min_inliers:
            self._map.clear()
            self._doubt(dt_s)
            return self._ego(LOST, 0, 0)
        self._previous, self._refused, self._strange, self._blind_s = sight.lower, 0, 0, 0.0
        return self._ego(TRACKING, len(self._map), len(self._map), Features(new=new))

    def _locate(self, seen: tuple[Sight, Flags], previous: Wrapped, expected: Array, dt_s: float) -> Fit | None:
        """The best supported pose of all guesses: as expected; in doubt, after a turn; after a break, at a keyframe.

        In the dark nothing is searched: once a pose was refused, a picture without corners is not worth it.
        """
        sight, usable = seen
        if self._refused and not self._is_textured(sight, usable):
            return None
        fit = self._search.from_guess(sight, expected)
        if not self._convincing(fit):
            guess = self._search.best_turn(sight, previous, (self._T, expected), usable)
            fit = _better(fit, self._search.from_guess(sight, guess))
        if not self._believable(fit, dt_s) and (self._refused or dt_s > self._limits.max_gap_s):
            fit = self._relocaliser.locate(sight)
        return fit if self._believable(fit, dt_s) else None

    def _convincing(self, fit: Fit | None) -> bool:
        limits = self._limits
        return (fit is not None and fit.tracked >= fit.visible / 2 and fit.share >= limits.sure_share
                and fit.agreeing >= limits.sure_inliers)

    def _believable(self, fit: Fit | None, dt_s: float) -> bool:
        """Whether enough landmarks agree, and the robot would not have to fly."""
        if fit is None or fit.agreeing < self._limits.min_inliers or fit.share < self._limits.min_share:
            return False
        moved = float(np.linalg.norm(fit.T_odom_rect[:3, 3] - self._T[:3, 3]))
        return moved <= self._limits.max_speed_mps * (max(dt_s, 0.05) + self._blind_s)

    def _accept(self, sight: Sight, usable: Flags, fit: Fit, dt_s: float) -> Ego:
        """Takes the pose over."""
        doubtful = self._refused > 0 or dt_s > self._limits.max_gap_s or fit.agreeing < self._limits.sure_inliers
        if self._refused or not 0 < dt_s <= self._limits.max_gap_s:
            self._filter.reset()
        else:
            self._filter.update(se3.inverse(self._T) @ fit.T_odom_rect, fit.covariance, dt_s)
        self._covariance = fit.covariance + (self._inherited(fit) if len(fit.landmarks) else 0.0)
        self._T, self._previous = fit.T_odom_rect, sight.lower
        self._refused = self._strange = 0
        self._blind_s = 0.0
        self._pattern.observe(sight.lower.panorama, self._T)
        features = Features(fit.pixels, fit.rejected, self._refresh_map(sight, usable, fit))
        return self._ego(DEGRADED if doubtful else TRACKING, fit.tracked, fit.agreeing, features)

    def _refuse(self, sight: Sight, usable: Flags, expected: Array, dt_s: float) -> Ego:
        """Goes on as expected, slowing down, with a covariance that grows; starts anew when nothing helps."""
        self._refused += 1
        A = se3.adjoint(se3.inverse(expected) @ self._T)
        self._T, self._covariance = expected, A @ self._covariance @ A.T
        self._filter.slow_down(math.exp(-dt_s / SLOWING_S))
        self._doubt(dt_s)
        lost = self._refused >= self._limits.lost_after
        if lost and self._is_textured(sight, usable):
            self._strange += 1
        if self._strange >= self._limits.restart_after:
            return self._restart(sight, usable, dt_s)
        return self._ego(LOST if lost else DEGRADED, 0, 0)

    def _doubt(self, dt_s: float) -> None:
        """Lets the covariance grow by what may have happened unseen, as an unknown but steady motion does."""
        before, self._blind_s = self._blind_s, self._blind_s + dt_s
        self._covariance = self._covariance + BLIND_SPEED**2 * (self._blind_s**2 - before**2) * np.eye(6)

    def _restart(self, sight: Sight, usable: Flags, dt_s: float) -> Ego:
        """A new map from here on: the gap stays in the covariance, and the reset counter says so."""
        self._map.clear()
        self._previous = None
        self._relocaliser.forget()
        self._filter.reset()
        self._resets += 1
        return self._begin(sight, usable, dt_s)

    def _is_textured(self, sight: Sight, usable: Flags) -> bool:
        return len(corners(sight.lower, usable, 4 * self._limits.min_inliers)) >= 2 * self._limits.min_inliers

    def _refresh_map(self, sight: Sight, usable: Flags, fit: Fit) -> Array:
        """Forgets landmarks that stay away, and adds a keyframe where too few are left; the pixels of new landmarks."""
        self._map.saw(sight.lower, fit.landmarks, fit.pixels)
        agreeing, limits = len(fit.landmarks), self._limits
        if limits.keyframes == 1:  # frame to frame: all landmarks are new, for those of before go with their keyframe
            return self._add_keyframe(sight, usable, np.zeros((0, 2)))
        self._most_agreeing = max(self._most_agreeing, agreeing)
        self._since_keyframe += 1
        sparse = agreeing < limits.refresh * limits.features and self._since_keyframe >= limits.sparse_every
        if sparse or agreeing < limits.refresh * self._most_agreeing or agreeing < limits.sure_inliers:
            return self._add_keyframe(sight, usable, fit.pixels)
        return np.zeros((0, 2))

    def _add_keyframe(self, sight: Sight, usable: Flags, known: Array) -> Array:
        """Fills the gaps between known landmarks with new ones, located by SAD and refined by KLT; their pixels."""
        free = clear_around(usable, known, 9)
        points = corners(sight.lower, free, self._limits.features - len(known))
        guess = points[:, 1] + nearby_disparity(sight.disparity, points)
        rows = rows_in_upper((sight.lower, sight.upper), points, guess, self._stereo_klt)
        located = np.isfinite(rows)
        keyframe = Keyframe(sight.seq, sight.lower, self._T, self._covariance)
        slopes = disparity_slopes(sight.disparity, points[located], (rows - points[:, 1])[located])
        self._map.add(keyframe, np.column_stack([points, rows])[located], slopes)
        if len(self._map) >= self._limits.min_inliers:
            self._relocaliser.remember(sight, keyframe)
        self._most_agreeing = self._since_keyframe = 0
        return points[located]

    def _inherited(self, fit: Fit) -> Array:
        """Covariance (6, 6) that comes with the keyframes in which the agreeing landmarks are anchored."""
        share = self._map.anchor_shares(fit.landmarks)
        A = {seq: se3.adjoint(se3.inverse(fit.T_odom_rect) @ self._map.keyframes[seq].T_odom_rect) for seq in share}
        parts = [s * A[seq] @ self._map.keyframes[seq].covariance @ A[seq].T for seq, s in share.items()]
        return np.asarray(sum(parts, np.zeros((6, 6))))

    def _ego(self, state: str, tracked: int, agreeing: int, features: Features | None = None) -> Ego:
        return Ego(self._T, self._covariance, self._filter.velocity, self._filter.velocity_covariance, state,
                   self._resets, tracked, agreeing, features or Features())


def _better(a: Fit | None, b: Fit | None) -> Fit | None:
    """The fit with more agreeing landmarks."""
    return max((fit for fit in (a, b) if fit), key=lambda fit: fit.agreeing, default=None)
