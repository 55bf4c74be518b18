"""Visual odometry of the stereo rig: predict, track, estimate, refine, accept or refuse, update the map.

VisualOdometry.process is the algorithm, one frame at a time. Equations and sections are those of Dang et al. 2012.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.corners import corners
from omnid.core.odometry.estimates import (
    ROOM_M,
    GapStep,
    OdometryEstimate,
    OdometryLimits,
    PoseEstimate,
    supports,
)
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.odometry.image_breaks import ImageBreaks, RawImage
from omnid.core.odometry.keyframes import KeyframeLocaliser, KeyframeRequest, Keyframes
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_filter import UNKNOWN_SPEED_SIGMA, MotionFilter, bounded
from omnid.core.odometry.motion_hypotheses import REACH_SIGMAS, MotionHypotheses
from omnid.core.odometry.pose_search import OUTLIER_COST, PoseSearch
from omnid.core.odometry.static_mask import StaticMask
from omnid.core.odometry.stereo_frame import Features, StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.odometry.tracking_state_machine import TrackingStatus
from omnid.core.types.stereo_model import StereoModel
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Rounds of starting the map again, because the depths of the first frame are measured as if the rig were at rest, so
# that the motion is wrong by a few per cent of what happens between two exposures, and each reduces it by this ratio.
START_ROUNDS = 2
SHORTEST_STEP_S = 0.05  # the speed limit counts at least this time, so that two close stamps refuse no pose
# Corners per landmark of the smallest map: two make a frame textured, since not all will be located; four are sought.
TEXTURED_CORNERS, COUNTED_CORNERS = 2, 4
# Share of the landmarks in view, inliers, below which a pose after a break is doubtful. Wrong ones at 10 m/s before a
# limit of 5 had 0.09, 0.24 and 0.27 (set on seed 3 of `honesty`, too fast).
AGAIN_SHARE = 1 / 3


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
        self._map = LocalMap(model, klt, limits.keyframes)
        self._keyframes = Keyframes(self._map, model, replace(klt, levels=1), limits, relocaliser)
        self._motion = motion or MotionFilter()
        self._static_mask = StaticMask(model.cylinder.edges_rad)
        self._T_odom_rect = np.eye(4)
        self._T_at_fix = self._T_odom_rect  # the last accepted pose
        self._status = TrackingStatus()
        self._hypotheses = MotionHypotheses()
        self._step: Array | None = None  # last step by the cameras
        self._is_measured = False  # wheels and gyro have measured the last step
        self._first: StereoFrame | None = None  # started the map before its velocity was known
        self._requested: KeyframeRequest | None = None  # keyframe that the last frame asked for, see complete
        self._added: int | None = None  # seq of the keyframe that the last frame became
        self._distance_m = ROOM_M  # median of the landmarks by which the last pose was found
        self._cost: tuple[float, int] | None = None  # of those in view, and their number; None: no pose was found
        self._search = PoseSearch(self._map, model, limits, klt)
        self.breaks = None if raw_images is None else ImageBreaks(model, raw_images)

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, dt_s [s] after the previous one (0 for the first).

        The keyframe that it may have to become is made by `complete`: its depths take longer than the pose. The pose is
        degraded at best while the images are torn or displaced.
        """
        estimate = self._pose(frame, dt_s)
        if self.breaks is None or not frame.times.is_at_once:
            return estimate
        pair = frame.lower, frame.upper
        self.breaks.add(frame.seq, pair, estimate.T_odom_rect, self._map, dt_s, self._cost)
        if not self.breaks.fault and not self.breaks.covariance.any():
            return estimate
        is_torn = self.breaks.fault and estimate.state is TrackingState.TRACKING
        state = TrackingState.DEGRADED if is_torn else estimate.state
        covariance = bounded(estimate.covariance + self.breaks.covariance)
        return replace(estimate, state=state, covariance=covariance, image_fault=self.breaks.fault)

    def _pose(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, whose images are whole: the algorithm."""
        self.complete()
        dt_s = max(dt_s, 0.0)
        self._step = self._cost = None
        self._map.lost = frame.lost
        usable = self._static_mask.without(frame.usable)
        if self._map.last is None:
            return self._start_without_map(frame, usable, dt_s)

        # 1. Predict: v <- v + dt a, T <- T exp(v dt) (section IV.D, eq. 10), with wheels and gyro where there are some.
        T_predicted = self._predicted(frame, dt_s)

        # 2. to 4. Track, estimate and refine: pose_search.py. Once a frame was refused, those without corners
        #    (darkness, a blank wall) are left out to save time.
        after_refusal = self._status.is_refused
        searched = not after_refusal or self._is_textured(frame, usable)
        sigma_mps = math.sqrt(float(np.linalg.eigvalsh(self._motion.velocity_covariance[:3, :3])[-1]))
        found = self._find(frame, usable, T_predicted, dt_s, sigma_mps) if searched else []
        if self._first is not None:
            found = self._start_again(frame, usable, found, dt_s)

        # 5. Accept or refuse, by the inliers and the speed that the pose implies; after a break, relocalise.
        plausible = [each for each in found if self._is_plausible(each, dt_s)]
        too_fast_mps = 0.0
        if found and not plausible and self._has_support(found[0]):
            too_fast_mps = self._too_fast_mps(found[0], dt_s)
        is_doubtful = not plausible or plausible[0].inliers < min(
            self._limits.good_inliers, AGAIN_SHARE * plausible[0].visible
        )
        if searched and is_doubtful and (after_refusal or dt_s > self._limits.max_gap_s):
            recognised = self.relocalise(frame, self._exposure(frame, dt_s))
            plausible = [recognised] if recognised is not None and self._is_plausible(recognised, dt_s) else []
        # Predicted poses were published: one in a place far from them does not close the gap, as odom would jump.
        gap = GapStep.between(T_predicted, plausible[0].T_odom_rect) if plausible and after_refusal else GapStep()
        if not plausible or gap.is_far:
            self._hypotheses.predict(dt_s)
            if too_fast_mps:
                self._add_fast(found[0].T_odom_rect, T_predicted, dt_s)
            known = bool(plausible) and plausible[0].inliers >= self._limits.good_inliers
            stayed = GapStep.between(self._T_at_fix, T_predicted).keeps_view and not supports(found, T_predicted)
            refused = self._refuse(frame, usable, T_predicted, dt_s, stayed=stayed, gap=gap if known else None)
            return replace(refused, refused_mps=too_fast_mps)
        chosen, contradicting = self._hypotheses.choose(plausible, T_predicted, self._since_fix_s(dt_s), sigma_mps)
        estimate = self._search.with_doubtful_depths(chosen)

        # 6. Update the filter (eq. 11), the pose, the mask of what is fixed to the rig, and the map.
        self._accept(frame, estimate, dt_s, turned=gap.is_turned)
        new = estimate.pixels[self._map.table.anchor[estimate.landmarks] == self._added]
        self._added = None
        exposure = self._exposure(frame, dt_s)
        self._map.give_up(contradicting)
        self._requested = self._update_map(frame, usable, estimate, exposure, dt_s)
        features, is_keyframe = Features(estimate.pixels, estimate.rejected, new), self._requested is not None
        exposure = exposure if is_keyframe else self._exposure(frame)
        result = self._result(estimate.tracked, estimate.inliers, features, exposure)
        return replace(result, is_keyframe=is_keyframe)

    def _find(
        self, frame: StereoFrame, usable: Flags, T_predicted: Array, dt_s: float, sigma_mps: float
    ) -> list[PoseEstimate]:
        """Return the pose of a frame in the map, and those of other motions that it may have been; none: no landmarks.

        sigma_mps: standard deviation of the predicted velocity.
        """
        exposure = self._exposure(frame, dt_s)
        sensed_m = math.nan
        if self._is_measured:
            self._hypotheses.agree()
            sensed_m = float(np.linalg.norm(T_predicted[:3, 3] - self._T_odom_rect[:3, 3]))
        self._map.decide_first_depths(frame.lower, (self._limits.max_speed_mps * dt_s, sensed_m))
        found = self._search.find(frame, usable, self._T_odom_rect, T_predicted, exposure)
        # After a refused frame the displacements from an unknown place lead anywhere: relocalisation decides.
        if found is None or self._status.is_refused:
            return [] if found is None else [found]
        most_mps = REACH_SIGMAS * sigma_mps + float(np.linalg.norm(self._hypotheses.fastest))
        reach_m = min(most_mps, self._limits.max_speed_mps) * self._since_fix_s(dt_s)
        return [found, *self._search.others(frame, found, T_predicted, exposure, reach_m)]

    def _add_fast(self, T_refused: Array, T_predicted: Array, dt_s: float) -> None:
        """Add the motion of a pose that was refused for its speed, since the vehicle may be as fast."""
        velocity = (T_refused[:3, 3] - self._T_at_fix[:3, 3]) / self._since_fix_s(dt_s)
        published = self._T_odom_rect[:3, :3] @ self._motion.velocity[:3]
        self._hypotheses.add(T_predicted, T_refused, velocity - published)

    def _start_again(
        self, frame: StereoFrame, usable: Flags, found: list[PoseEstimate], dt_s: float
    ) -> list[PoseEstimate]:
        """Start the map again at its first frame, whose velocity this one shows; return the pose in that map."""
        first, self._first = self._first, None
        if first is None or not 0 < dt_s <= self._limits.max_gap_s:
            return found
        for _ in range(START_ROUNDS):
            if not found or not self._is_plausible(found[0], dt_s):
                break
            velocity = self._motion.of_step(se3.inverse(self._T_odom_rect) @ found[0].T_odom_rect, dt_s)
            self._map.clear()
            exposure = Exposure.of(first.times, velocity, self._model)
            self._keyframes.add(self._request(first, usable & first.usable, exposure))
            exposure = Exposure.of(frame.times, velocity, self._model)
            again = self._search.estimate(frame, found[0].T_odom_rect, exposure, is_near=True)
            found = [] if again is None else [again]
        return found

    def _exposure(self, frame: StereoFrame, dt_s: float = 0.0) -> Exposure:
        """Return the exposure of a frame by the filter's velocity, after a step of dt_s was predicted to it."""
        return Exposure.of(frame.times, self._motion.at_exposure(dt_s), self._model)

    def relocalise(self, frame: StereoFrame, exposure: Exposure) -> PoseEstimate | None:
        """Return the pose of a frame among the newest keyframes, refined by the patches of the local map in view."""
        found = self._relocaliser.locate(frame)
        return None if found is None else self._search.refine_recognised(frame, found, exposure)

    def complete(self) -> None:
        """Make the last frame a keyframe if the map needs one; the next `process` does so where this is not called.

        Called between the two, it gives the same results, and the pose is not held up.
        """
        requested, self._requested = self._requested, None
        if requested is not None:
            self._keyframes.add(requested)
            self._added = requested.frame.seq

    def _is_plausible(self, estimate: PoseEstimate, dt_s: float) -> bool:
        """True if the pose has enough inliers and implies no impossible speed since the last accepted one."""
        return self._has_support(estimate) and not self._too_fast_mps(estimate, dt_s)

    def _too_fast_mps(self, estimate: PoseEstimate, dt_s: float) -> float:
        """Return the speed that a pose implies since the last accepted one if it is impossible, else 0."""
        moved_m = estimate.distance_m(self._T_odom_rect)
        since_s = self._since_fix_s(dt_s)
        return moved_m / since_s if moved_m > self._limits.max_speed_mps * since_s else 0.0

    def _has_support(self, estimate: PoseEstimate) -> bool:
        """True if the pose has enough inliers in both cameras."""
        limits = self._limits
        return estimate.inliers >= limits.min_inliers and estimate.least_ratio >= limits.min_inlier_ratio

    def _since_fix_s(self, dt_s: float) -> float:
        """Return the time since the last accepted pose, at a frame dt_s after the one before."""
        return max(dt_s, SHORTEST_STEP_S) + self._status.time_since_fix_s

    def _is_textured(self, frame: StereoFrame, usable: Flags) -> bool:
        """True if the frame has enough corners for a map."""
        smallest = self._limits.min_inliers
        return len(corners(frame.lower, usable, COUNTED_CORNERS * smallest)) >= TEXTURED_CORNERS * smallest

    def _accept(self, frame: StereoFrame, estimate: PoseEstimate, dt_s: float, *, turned: bool) -> None:
        """Update the filter, from standstill after a break, and set the pose; turned: its heading is a jump of odom."""
        at_previous: RigVelocity | None = None
        if not self._status.is_refused and 0 < dt_s <= self._limits.max_gap_s:
            T_prev_curr = se3.inverse(self._T_odom_rect) @ estimate.T_odom_rect
            is_at_once = frame.times.is_at_once
            is_sure = estimate.inliers >= self._limits.good_inliers and not self._is_in_doubt(estimate)
            at_previous = self._motion.accept(
                T_prev_curr,
                estimate.covariance,
                dt_s,
                interval_s=frame.interval_s,
                is_sure=is_sure,
                exposed_at_once=is_at_once,
            )
            self._step = T_prev_curr if is_sure else None
        elif not self._is_measured:
            self._motion.reset()
        self._map.late_depths.settle(at_previous)
        self._motion.found(estimate.covariance + self._map.covariance_of(estimate))
        self._T_odom_rect = self._T_at_fix = estimate.T_odom_rect
        # What the upper camera does not show where it must be is an outlier there.
        self._cost = estimate.cost + OUTLIER_COST * (1.0 - estimate.upper_ratio), estimate.in_view
        if len(estimate.landmarks):
            away = self._map.table.points[estimate.landmarks] - self._T_odom_rect[:3, 3]
            self._distance_m = float(np.median(np.linalg.norm(away, axis=1)))
        limits = self._limits
        is_doubtful = self._is_in_doubt(estimate) or estimate.inliers < limits.good_inliers
        is_doubtful |= estimate.upper_ratio < limits.good_inlier_ratio
        self._advance(self._status.accepted(dt_s, limits, doubtful=is_doubtful, turned=turned))
        self._static_mask.observe(frame.lower.panorama, self._T_odom_rect)

    def _is_in_doubt(self, estimate: PoseEstimate) -> bool:
        """True if it is not known which of several motions was made, or which depths are right."""
        return estimate.doubtful_depths or not self._hypotheses.is_single

    def _refuse(
        self, frame: StereoFrame, usable: Flags, T_predicted: Array, dt_s: float, *, stayed: bool, gap: GapStep | None
    ) -> OdometryEstimate:
        """Continue with the predicted pose, with a growing covariance; start the map again if need be.

        stayed: see TrackingStatus; gap: from the predicted to the recognised pose, None: not recognised elsewhere.
        """
        known = gap is not None
        carried = self._carry(T_predicted, dt_s) and not known
        textured = self._is_textured(frame, usable)
        status = self._status.refused(
            dt_s, self._limits, textured=textured, elsewhere=known, carried=carried, stayed=stayed
        )
        self._advance(status, carried=carried)
        if not self._status.restart:
            return self._result(0, 0, exposure=self._exposure(frame))
        self._map.clear()
        self._relocaliser.clear()
        if gap is not None:
            self._motion.distrust(gap.covariance)
        if self._status.unknown_motion:
            self._motion.reset()
        return self._start_map(frame, usable, 0.0, elsewhere=known, carried=carried)

    def _start_without_map(self, frame: StereoFrame, usable: Flags, dt_s: float) -> OdometryEstimate:
        """Start a map where there is none, after the motion that wheels and gyro measured."""
        carried = dt_s > 0 and self._carry(self._predicted(frame, dt_s), dt_s)
        return self._start_map(frame, usable, dt_s, carried=carried)

    def _predicted(self, frame: StereoFrame, dt_s: float) -> Array:
        """Return the predicted pose (4, 4) at a frame; only wheels and gyro know what happened in a long gap."""
        T_prev_curr, self._is_measured = self._motion.step(frame.interval_s, dt_s, self._limits.max_gap_s)
        return self._T_odom_rect @ T_prev_curr

    def _carry(self, T_predicted: Array, dt_s: float) -> bool:
        """Go on to the predicted pose; return whether wheels and gyro carry it."""
        limits = self._limits
        self._T_odom_rect = T_predicted
        return self._motion.carry(
            dt_s, is_measured=self._is_measured, most_s=limits.bridge_s, most_sigma_m=limits.bridge_sigma_m
        )

    def _start_map(
        self, frame: StereoFrame, usable: Flags, dt_s: float, *, carried: bool, elsewhere: bool = False
    ) -> OdometryEstimate:
        """Start a map at the current pose if the frame has enough landmarks; the facts: see TrackingStatus."""
        exposure = self._exposure(frame)
        new = self._keyframes.add(self._request(frame, usable, exposure))
        if len(self._map) < self._limits.min_inliers:
            self._map.clear()
            self._advance(self._status.without_map(dt_s, carried=carried), carried=carried)
            return self._result(0, 0, exposure=exposure)
        self._first = None if frame.times.is_at_once else frame
        self._motion.found(self._motion.pose_covariance)
        self._advance(self._status.started(carried=carried, elsewhere=elsewhere), carried=carried)
        return replace(self._result(len(self._map), len(self._map), Features(new=new), exposure), is_keyframe=True)

    def _advance(self, status: TrackingStatus, *, carried: bool = False) -> None:
        """Advance the tracking state."""
        if carried and not self._status.unknown_motion and status.unknown_motion:
            # What carried the pose is contradicted now, and has measured nothing since the last fix.
            self._motion.distrust((UNKNOWN_SPEED_SIGMA * status.time_since_fix_s) ** 2 * np.eye(6))
        self._status = status
        if status.time_since_fix_s == 0:
            self._T_at_fix = self._T_odom_rect

    def _update_map(
        self, frame: StereoFrame, usable: Flags, estimate: PoseEstimate, exposure: Exposure, dt_s: float
    ) -> KeyframeRequest | None:
        """Remove lost landmarks; return the keyframe that is to be added, where too few are left."""
        ids = self._map.table.id[estimate.landmarks]
        self._map.late_depths.seen(ids, estimate)
        self._map.update_tracked(frame.lower, estimate.landmarks, estimate.pixels)
        if not self._keyframes.is_due(len(estimate.landmarks), dt_s):
            return None
        request = self._request(frame, usable, exposure)
        if self._limits.keyframes == 1:
            return request
        return replace(request, pixels=estimate.pixels, views=estimate.views)

    def _request(self, frame: StereoFrame, usable: Flags, exposure: Exposure) -> KeyframeRequest:
        """Return the request of a keyframe at the current pose, all of whose landmarks are new."""
        return KeyframeRequest(frame, usable, self._T_odom_rect, self._motion.pose_covariance, exposure)

    def _result(
        self, tracked: int, inliers: int, features: Features | None = None, exposure: Exposure | None = None
    ) -> OdometryEstimate:
        others_mps = np.pad(self._T_odom_rect[:3, :3].T @ self._hypotheses.fastest, (0, 3))
        return OdometryEstimate(
            self._T_odom_rect,
            self._motion.pose_covariance + self._hypotheses.covariance(self._T_odom_rect),
            self._motion.velocity,
            self._motion.velocity_covariance + np.outer(others_mps, others_mps),
            self._status.state,
            self._status.resets,
            tracked,
            inliers,
            features or Features(),
            self._step,
            exposure=exposure,
            distance_m=self._distance_m,
        )
