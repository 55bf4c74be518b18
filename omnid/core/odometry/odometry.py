"""Visual odometry of the stereo rig: predict, track, estimate, refine, accept or refuse, update the map.

VisualOdometry.process is the algorithm, one frame at a time. Equations and sections are those of Dang et al. 2012.

A pose by the cameras is TRACKING; DEGRADED with few inliers, few of them in the upper camera, with more than one
hypothesis of the motion, after a gap or a refused frame, or by images that are broken. A frame without one is
predicted: DEGRADED until the position's uncertainty has grown by bridge_sigma_m since the last fix, which wheels and
gyro delay by bridge_s at most, and then LOST. The map is started again when frames with texture have matched nothing
for restart_s, or one was recognised elsewhere; where the pose is LOST, the reset counter rises.

What contradicts the prediction is in the covariance: the gap to where a frame was recognised, and any motion where a
map is started again although wheels and gyro say that the base has hardly moved. The old map would be in view, so the
base was carried away, or they are wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import clear_around, corners
from omnid.core.odometry.estimates import ROOM_M, OdometryEstimate, OdometryLimits, PoseEstimate
from omnid.core.odometry.exposure_times import NO_VELOCITY, Exposure
from omnid.core.odometry.image_breaks import ImageBreaks
from omnid.core.odometry.line_times import RawImage
from omnid.core.odometry.local_map import Keyframe, LocalMap
from omnid.core.odometry.motion_filter import CAMERA_SIGMA, UNKNOWN_SPEED_SIGMA, MotionFilter, bounded
from omnid.core.odometry.motion_hypotheses import REACH_SIGMAS, OtherMotion
from omnid.core.odometry.new_landmarks import located
from omnid.core.odometry.pose_estimation import OUTLIER_SQUARED
from omnid.core.odometry.pose_search import OUTLIER_COST, PoseSearch
from omnid.core.odometry.static_mask import StaticMask
from omnid.core.odometry.stereo_frame import Features, StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]

SHORTEST_STEP_S = 0.05  # the speed limit counts at least this time, so that two close stamps refuse no pose
# Corners per landmark of the smallest map that make a frame textured, since not all will be located.
TEXTURED_CORNERS = 2
# Parts of the full turn, half of which few inliers must fill to support a pose, and the least share of the tracks.
AROUND, NEARLY_ALL = 12, 0.9
# A larger step of odom would be a jump for the readers of published poses, as REP 105 has odom continuous: it raises
# reset_counter, or the gap stays open.
JUMP_M, JUMP_RAD = 0.5, math.radians(30)
# A smaller step keeps the view: landmarks are a metre away and farther, so that they move by 6 degrees at most besides
# the turn.
SAME_VIEW_M, SAME_VIEW_RAD = 0.1, math.radians(10)


class KeyframeLocaliser(Protocol):
    """A bounded store of keyframes that gives the pose of a frame among them; see core/places."""

    def add(self, frame: StereoFrame, keyframe: Keyframe) -> None:
        """Keep a keyframe and its frame."""

    def clear(self) -> None:
        """Drop all keyframes."""

    def locate(self, frame: StereoFrame) -> PoseEstimate | None:
        """Return the pose of a frame among the keyframes; None if it fits none."""


@dataclass(frozen=True, slots=True)
class _Prediction:
    """A frame and what is known of it before its landmarks are searched."""

    frame: StereoFrame  # usable: without what is fixed to the rig
    dt_s: float
    since_fix_s: float  # since the last accepted pose
    T_odom_rect: Array  # (4, 4) predicted
    sigma_mps: float  # standard deviation of the velocity
    is_measured: bool  # by wheels and gyro
    exposure: Exposure


class VisualOdometry:
    """Estimate the pose of the rectified frame; odom is the rectified frame of the first pair."""

    def __init__(
        self,
        model: StereoModel,
        klt: KltSettings,
        limits: OdometryLimits,
        relocaliser: KeyframeLocaliser,
        raw_images: tuple[RawImage, RawImage] | None = None,
        motion: MotionFilter | None = None,
    ) -> None:
        """motion: the filter with the samples of wheels and gyro; None: there are none.

        raw_images: where the raw images of both cameras show the panoramas; None: they are not tested for breaks.
        """
        self._limits, self._model, self._relocaliser = limits, model, relocaliser
        self._upper_klt = replace(klt, levels=1)  # from the lower panorama to the upper one
        self._map = LocalMap(model, klt, limits.keyframes)
        self._search = PoseSearch(self._map, model, limits)
        self._motion, self._other = motion or MotionFilter(), OtherMotion()
        self._static_mask = StaticMask(model.cylinder)
        self._T_odom_rect = np.eye(4)
        self._error = np.zeros((6, 0))  # [t; r] of it, by the draws of the keyframes and one of its own
        self._state, self._resets = TrackingState.LOST, 0  # resets: odom lost its relation to what was published
        self._T_at_fix: Array | None = None  # the last accepted pose; None: there was no map yet
        self._unmatched_s = 0.0  # of frames that were searched in vain since
        self._first: _Prediction | None = None  # started the map before its velocity was known
        self._step: Array | None = None  # last step by the cameras
        self._add_keyframe: Callable[[], None] | None = None  # the keyframe that the last frame asked for
        self._most_inliers, self._tracked_s = 0, 0.0  # since the last keyframe
        self._distance_m = ROOM_M  # median of the landmarks by which the last pose was found
        self._cost: tuple[float, int] | None = None  # of those in view, and their number; None: no pose was found
        self.breaks = None if raw_images is None else ImageBreaks(model, raw_images)

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, dt_s [s] after the previous one (0 for the first).

        The keyframe that it may have to become is made by `complete`: its depths take longer than the pose. The pose is
        degraded at best while the images are torn or displaced.
        """
        estimate = self._pose(frame, max(dt_s, 0.0))
        if self.breaks is None:
            return estimate
        self.breaks.add((frame.lower, frame.upper), estimate, self._map, dt_s, self._cost)
        is_torn = self.breaks.fault and estimate.state is TrackingState.TRACKING
        state = TrackingState.DEGRADED if is_torn else estimate.state
        covariance = bounded(estimate.covariance + self.breaks.covariance)
        return replace(estimate, state=state, covariance=covariance, image_fault=self.breaks.fault)

    def complete(self) -> None:
        """Make the last frame a keyframe if the map needs one; the next `process` does so where this is not called.

        Called between the two, it gives the same results, and the pose is not held up.
        """
        add, self._add_keyframe = self._add_keyframe, None
        if add is not None:
            add()

    def relocalise(self, frame: StereoFrame, exposure: Exposure) -> PoseEstimate | None:
        """Return the pose of a frame among the newest keyframes, refined by the patches of the local map in view."""
        found = self._relocaliser.locate(frame)
        return None if found is None else self._search.refine_recognised(frame, found, exposure, JUMP_M)

    def _pose(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, whose images are whole: the algorithm."""
        self.complete()
        limits, self._step, self._cost, self._map.lost = self._limits, None, None, frame.lost

        # 1. Predict: v <- v + dt a, T <- T exp(v dt) (section IV.D, eq. 10), with wheels and gyro where there are some;
        #    only they know a long gap.
        interval_s = None if self._is_lost else frame.interval_s
        T_prev_curr, is_measured = self._motion.step(interval_s, dt_s, limits.max_gap_s)
        now = _Prediction(
            replace(frame, usable=self._static_mask.without(frame.usable)),
            dt_s,
            max(dt_s, SHORTEST_STEP_S) + self._motion.since_found_s,
            self._T_odom_rect @ T_prev_curr,
            math.sqrt(float(np.linalg.eigvalsh(self._motion.velocity_covariance[:3, :3])[-1])),
            is_measured,
            self._exposure(frame, dt_s),
        )
        if self._map.last is None:
            self._carry(now)
            return self._start_map(now)

        # 2. to 4. Track, estimate and refine: pose_search.py. Once a frame was refused, those without corners
        #    (darkness, a blank wall) are left out to save time.
        searched = not self._was_refused or self._is_textured(now)
        found = self._find(now) if searched else []
        first, self._first = self._first, None
        if first is not None and found and 0 < dt_s <= limits.max_gap_s and self._is_plausible(found[0], now):
            found = self._start_again(first, now, found[0])

        # 5. Accept or refuse, by the inliers in both cameras and the speed that the pose implies; after a break,
        #    relocalise, also where there are too few inliers to be relied on after an unknown motion.
        plausible = [each for each in found if self._is_plausible(each, now)]
        is_too_fast = bool(found) and not plausible and found[0].has_support(limits)
        if searched and (self._was_refused or dt_s > limits.max_gap_s):
            relied = min(limits.good_inliers, limits.min_inlier_ratio * plausible[0].visible) if plausible else 0.0
            if not plausible or plausible[0].inliers < relied:
                recognised = self.relocalise(now.frame, now.exposure)
                plausible = [recognised] if recognised is not None and self._is_plausible(recognised, now) else []
        # Predicted poses were published: one in a place far from them does not close the gap, as odom would jump.
        gap = _step(now.T_odom_rect, plausible[0].T_odom_rect) if plausible and self._was_refused else np.zeros(6)
        if not plausible or np.linalg.norm(gap[:3]) > JUMP_M:
            self._other.predict(dt_s)
            if is_too_fast:  # the vehicle may be as fast
                self._other.replace(now.T_odom_rect, found[0].T_odom_rect, now.since_fix_s)
            is_known = bool(plausible) and plausible[0].inliers >= limits.good_inliers
            return self._refuse(now, found, gap if is_known else None, searched=searched)
        estimate = self._other.choose(plausible, now.T_odom_rect, now.since_fix_s, now.sigma_mps)
        estimate = self._at_rest(estimate)

        # 6. Update the filter (eq. 11), the pose, the mask of what is fixed to the rig, and the map.
        self._accept(now, estimate, is_reset=bool(np.linalg.norm(gap[3:]) > JUMP_RAD))
        exposure, inliers = self._exposure(frame, dt_s), len(estimate.landmarks)
        self._map.accept(frame.lower, estimate)
        self._most_inliers, self._tracked_s = max(self._most_inliers, inliers), self._tracked_s + dt_s
        is_keyframe = inliers < max(limits.good_inliers, limits.refresh * self._most_inliers)
        is_keyframe |= inliers < limits.refresh * limits.features and self._tracked_s >= limits.sparse_s
        if is_keyframe:
            self._add_keyframe = partial(self._make_keyframe, now, exposure, estimate)
        features = Features(estimate.pixels, estimate.rejected)
        result = self._result(estimate.tracked, estimate.inliers, exposure, features)
        return replace(result, is_keyframe=is_keyframe)

    def _exposure(self, frame: StereoFrame, dt_s: float = 0.0) -> Exposure:
        """Return the exposure of a frame by the filter's velocity, after a step of dt_s was predicted to it."""
        motion = NO_VELOCITY if frame.times.is_synchronised else self._motion.at_exposure(dt_s)
        return Exposure(frame.times, motion, self._model)

    def _find(self, now: _Prediction) -> list[PoseEstimate]:
        """Return the pose of a frame in the map, and those of other motions; none: no landmarks were found."""
        if now.is_measured:
            self._other.agree()
        found = self._search.find(now.frame, self._T_odom_rect, now.T_odom_rect, now.exposure)
        # After a refused frame the displacements from an unknown place lead anywhere: relocalisation decides.
        if found is None or self._was_refused:
            return [] if found is None else [found]
        most_mps = REACH_SIGMAS * now.sigma_mps + float(np.linalg.norm(self._other.velocity))
        reach_m = min(most_mps, self._limits.max_speed_mps) * now.since_fix_s
        return [found, *self._search.others(now.frame, found, now.T_odom_rect, now.exposure, reach_m)]

    def _start_again(self, first: _Prediction, now: _Prediction, found: PoseEstimate) -> list[PoseEstimate]:
        """Start the map again at its first frame, whose velocity this one shows; return the pose in that map.

        The depths of the first frame were measured as if the rig were at rest, so that this step is wrong by a few per
        cent of what happens between two exposures.
        """
        velocity = self._motion.of_step(se3.inverse(self._T_odom_rect) @ found.T_odom_rect, now.dt_s)
        then, at = (Exposure(each.frame.times, velocity, self._model) for each in (first, now))
        self._map.clear()
        self._make_keyframe(first, then)
        again = self._search.estimate(now.frame, found.T_odom_rect, at, is_near=True)
        return [] if again is None else [again]

    def _is_plausible(self, estimate: PoseEstimate, now: _Prediction) -> bool:
        """True if the pose has enough inliers and implies no impossible speed since the last accepted one."""
        most_m = self._limits.max_speed_mps * now.since_fix_s
        return estimate.has_support(self._limits) and estimate.distance_m(self._T_odom_rect) <= most_m

    def _at_rest(self, estimate: PoseEstimate) -> PoseEstimate:
        """Return the estimate; if its step may be noise, at the last pose: noise would move a base at rest."""
        step = _step(self._T_odom_rect, estimate.T_odom_rect)
        information = np.linalg.inv(estimate.covariance) + np.diag(1.0 / CAMERA_SIGMA**2)
        if step @ information @ step >= OUTLIER_SQUARED:
            return estimate
        return replace(estimate, T_odom_rect=self._T_odom_rect, covariance=estimate.covariance + np.outer(step, step))

    def _is_textured(self, now: _Prediction) -> bool:
        """True if the frame has enough corners for a map."""
        least = TEXTURED_CORNERS * self._limits.min_inliers
        return len(corners(now.frame.lower, now.frame.usable, least)) >= least

    def _accept(self, now: _Prediction, estimate: PoseEstimate, *, is_reset: bool) -> None:
        """Update the filter, from standstill after a break, and set the pose; is_reset: its heading is a jump."""
        # 1. Whether many landmarks support the pose, or nearly all of few all around: they are no single moving object.
        limits, at_previous = self._limits, None
        is_after_gap = self._was_refused or now.dt_s > self._limits.max_gap_s
        parts = np.unique(np.floor(estimate.pixels[:, 0] * (AROUND / self._model.cylinder.period_px)) % AROUND)
        is_all = estimate.least_ratio >= NEARLY_ALL and len(parts) >= AROUND / 2
        is_sure = not self._other.is_open and (estimate.inliers >= limits.good_inliers or is_all)
        # 2. The filter, and the times of the rows.
        if not is_after_gap and now.dt_s > 0:
            T_prev_curr = se3.inverse(self._T_odom_rect) @ estimate.T_odom_rect
            interval_s = now.frame.interval_s if is_sure else None
            at_previous = self._motion.accept(T_prev_curr, estimate.covariance, now.dt_s, interval_s)
            self._step = T_prev_curr if is_sure else None
            if is_sure and self.breaks is not None:
                velocity = se3.log(T_prev_curr) / now.dt_s
                self.breaks.lines.add(now.frame.seq, estimate, self._map, velocity, now.dt_s)
        elif not now.is_measured:
            self._motion.reset()
        self._map.settle(at_previous)
        self._error = np.hstack([self._map.error_of(estimate), _root(estimate.covariance)])
        # 3. The pose and its state.
        self._T_odom_rect = estimate.T_odom_rect
        # What the upper camera does not show where it must be is an outlier there.
        self._cost = estimate.cost + OUTLIER_COST * (1.0 - estimate.upper_ratio), estimate.in_view
        away = self._map.table.points[estimate.landmarks] - self._T_odom_rect[:3, 3]
        self._distance_m = float(np.median(np.linalg.norm(away, axis=1)))
        is_doubtful = not is_sure or estimate.upper_ratio < limits.good_inlier_ratio or is_after_gap
        self._fix(self._error @ self._error.T, is_doubtful=is_doubtful, is_reset=is_reset)
        self._static_mask.observe(now.frame.lower.panorama, self._T_odom_rect)

    def _fix(self, covariance: Array, *, is_doubtful: bool, is_reset: bool) -> None:
        """Set covariance and state of a pose that was accepted, or at which a map was started."""
        self._motion.found(covariance)
        self._state = TrackingState.DEGRADED if is_doubtful else TrackingState.TRACKING
        self._resets += is_reset
        self._T_at_fix, self._unmatched_s = self._T_odom_rect, 0.0

    @property
    def _was_refused(self) -> bool:
        """True if the pose of the last frame was predicted, as none was found or accepted."""
        return self._motion.since_found_s > 0

    @property
    def _is_lost(self) -> bool:
        """True if the position is not known well enough since the last fix."""
        limits, motion = self._limits, self._motion
        return motion.grown_m2 > limits.bridge_sigma_m**2 or motion.since_found_s > limits.bridge_s

    def _refuse(
        self, now: _Prediction, found: list[PoseEstimate], gap: Array | None, *, searched: bool
    ) -> OdometryEstimate:
        """Continue with the predicted pose, with a growing covariance; start the map again if need be.

        found: poses that were not accepted; searched: the frame was searched for them. gap (6,): step from the
        predicted pose to the one that was recognised elsewhere; None: it was not.
        """
        # 1. Go on to the predicted pose. Of a gap without frames no more than max_gap_s counts, because nothing could
        #    be seen in it.
        limits = self._limits
        self._carry(now)
        if searched:
            self._unmatched_s += min(now.dt_s, limits.max_gap_s)
        assert self._T_at_fix is not None  # as there is a map
        # 2. What the frame says about the motion since the last fix: the gap, or, as the old map is not in view, that
        #    wheels and gyro are wrong if they say so. Most of the tracks, few as they may be, do not show it there.
        if gap is not None:
            self._motion.distrust(np.outer(gap, gap))
        elif self._unmatched_s < limits.restart_s:
            return self._result(0, 0, self._exposure(now.frame))
        elif not self._is_lost and _keeps_view(self._T_at_fix, now.T_odom_rect):
            is_shown = bool(found) and found[0].inlier_ratio > 0.5
            if not (is_shown and _keeps_view(now.T_odom_rect, found[0].T_odom_rect)):
                self._motion.distrust((UNKNOWN_SPEED_SIGMA * self._motion.since_found_s) ** 2 * np.eye(6))
        # 3. Start the map again. Another motion that led here stays in the covariance.
        self._other.keep()
        self._map.clear()
        self._relocaliser.clear()
        return self._start_map(now)

    def _carry(self, now: _Prediction) -> None:
        """Go on to the predicted pose."""
        self._T_odom_rect = now.T_odom_rect
        self._motion.carry(now.dt_s, is_measured=now.is_measured)
        is_known = not self._is_lost and (self._T_at_fix is not None or now.is_measured)
        self._state = TrackingState.DEGRADED if is_known else TrackingState.LOST

    def _start_map(self, now: _Prediction) -> OdometryEstimate:
        """Start a map at the predicted pose if the frame has enough landmarks."""
        exposure, covariance = self._exposure(now.frame), self._motion.pose_covariance
        self._error = _root(covariance)
        self._make_keyframe(now, exposure)
        if len(self._map) < self._limits.min_inliers:
            self._map.clear()
            return self._result(0, 0, exposure)
        self._first = None if now.frame.times.is_synchronised else now
        # A map that replaces a lost one says nothing about the motion between the two.
        is_again = self._T_at_fix is not None
        self._fix(covariance, is_doubtful=is_again, is_reset=is_again and self._is_lost)
        return replace(self._result(len(self._map), len(self._map), exposure), is_keyframe=True)

    def _make_keyframe(self, now: _Prediction, exposure: Exposure, seen: PoseEstimate | None = None) -> None:
        """Add the frame of the present pose to the map, with new landmarks.

        seen: the estimate whose landmarks stay; None: all are new.
        """
        pixels, views = (np.zeros((0, 2)), np.zeros((0, 3))) if seen is None else (seen.pixels, seen.views)
        points = corners(now.frame.lower, clear_around(now.frame.usable, pixels), self._limits.features - len(pixels))
        frame = replace(now.frame, exposure=exposure)
        new = located(frame, points, self._model, self._upper_klt, exposure, views)
        keyframe = Keyframe(frame.seq, frame.lower, self._T_odom_rect, self._error)
        self._map.add_keyframe(keyframe, new)
        if len(self._map) >= self._limits.min_inliers:
            self._relocaliser.add(frame, keyframe)
        self._most_inliers, self._tracked_s = 0, 0.0

    def _result(
        self, tracked: int, inliers: int, exposure: Exposure, features: Features | None = None
    ) -> OdometryEstimate:
        others_mps = np.pad(self._T_odom_rect[:3, :3].T @ self._other.velocity, (0, 3))
        return OdometryEstimate(
            self._T_odom_rect,
            self._motion.pose_covariance + self._other.covariance(self._T_odom_rect),
            self._motion.velocity,
            self._motion.velocity_covariance + np.outer(others_mps, others_mps),
            self._state,
            self._resets,
            tracked,
            inliers,
            features or Features(),
            self._step,
            exposure=exposure,
            distance_m=self._distance_m,
        )


def _step(T_a: Array, T_b: Array) -> Array:
    """Return the step (6,) [t; r] from one pose to another, in the axes of the first one."""
    return se3.log(se3.inverse(T_a) @ T_b)


def _root(covariance: Array) -> Array:
    """Return R (6, 6) with R R^T = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _keeps_view(T_a: Array, T_b: Array) -> bool:
    """True if two poses are so near that the same landmarks are in view."""
    step = _step(T_a, T_b)
    return bool(np.linalg.norm(step[:3]) < SAME_VIEW_M and np.linalg.norm(step[3:]) < SAME_VIEW_RAD)
