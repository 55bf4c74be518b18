"""Odometry stage: poses of the rectified frame become poses of the rig, and of the base."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.rig_uncertainty import motion_errors
from omnid.config import OdometryConfig
from omnid.core.control.motion_monitor import AGREE, Conflict
from omnid.core.nanoseconds import S_PER_NS
from omnid.core.odometry.earlier_view import EarlierView
from omnid.core.odometry.estimates import OdometryEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.line_times import RawImage
from omnid.core.odometry.motion_agreement import Contradiction, MotionAgreement
from omnid.core.odometry.motion_filter import MotionFilter
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.rig_error import RigError
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.relocalisation import Relocaliser
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel
from omnid.messages import OdometryUpdate, Panoramas, StereoDepth
from omnid.stages.dense_depths import DenseDepths
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]


class OdometryMethod(Protocol):
    """A method that estimates the pose of the rectified frame from pair to pair."""

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, dt_s [s] after the previous one (0 for the first)."""

    def complete(self) -> None:
        """Finish the work for the last frame now; otherwise `process` does so before the next one."""


class OdometryStage:
    """Estimate poses in odom, which is the rig frame of the first pair."""

    def __init__(
        self,
        geometry: Geometry,
        config: OdometryConfig,
        dense: DenseDepths,
        raw_images: tuple[RawImage, RawImage] | None = None,
    ) -> None:
        """dense: computes the depth of keyframes. raw_images: see VisualOdometry."""
        self._dense = dense
        self._T_rig_rect = geometry.T_rig_rect
        self._to_rig = se3.adjoint(self._T_rig_rect)
        self._last_ns: int | None = None
        self._keyframe: _LastKeyframe | None = None
        self._T_base_rect = geometry.rig.T_base_rig @ self._T_rig_rect
        self._to_base = se3.adjoint(self._T_base_rect)
        self.motion = MotionFilter(T_base_rect=self._T_base_rect)
        self._method = _method(geometry.model(config.noise_px), config, raw_images, self.motion)
        self._agreement = MotionAgreement(self.motion)
        self.last_fault = AGREE  # the last disagreement that was more than a doubt
        self._contradiction = Contradiction()
        self._rig_error = RigError(motion_errors(geometry.rig))

    @property
    def conflict(self) -> Conflict:
        """The present disagreement of images, wheels and gyro."""
        return self._agreement.result

    @property
    def image_faults(self) -> list[str]:
        """One line for each way in which the images of a camera are torn or displaced."""
        breaks = self._method.breaks if isinstance(self._method, VisualOdometry) else None
        return [] if breaks is None else breaks.words

    def process(self, pair: Panoramas) -> OdometryUpdate:
        """Return the pose at a pair."""
        # 1. What wheels and gyro have measured since the pair before.
        last_ns, self._last_ns = self._last_ns, pair.stamp_ns
        dt_s = 0.0 if last_ns is None else (pair.stamp_ns - last_ns) * S_PER_NS
        sensors = self.motion.sensors
        sensors.add(pair.motion)
        interval_s = None if last_ns is None else (sensors.seconds(last_ns), sensors.seconds(pair.stamp_ns))
        # 2. The pose of the rectified frame.
        usable = np.zeros_like(pair.visible) if pair.light.shows_nothing else pair.usable
        frame = StereoFrame(
            pair.seq,
            pair.lower,
            pair.upper,
            partial(self._disparity, pair),
            usable,
            pair.times,
            interval_s,
            lost=pair.tiles.lost_pixels(pair.visible.shape),
        )
        estimate = self._method.process(frame, dt_s)
        # 3. Compare its step with wheels and gyro over seconds.
        if estimate.step is not None and last_ns is not None:
            seen = self._to_base @ se3.log(estimate.step)
            self._agreement.add_step(last_ns, pair.stamp_ns, *map(float, seen[[0, 5, 1]]))
            if self.conflict.is_fault:
                self.last_fault = self.conflict
        # 4. The message, in the frame of the rig, with the uncertainty by what wheels and gyro contradict.
        covariance_rect = estimate.covariance + self._contradicted(estimate.T_odom_rect, pair.stamp_ns)
        return self._update(pair, estimate, covariance_rect)

    def _update(self, pair: Panoramas, estimate: OdometryEstimate, covariance_rect: Array) -> OdometryUpdate:
        """Return the message of an estimate at a pair; covariance_rect (6, 6): that of its pose by a right rig."""
        earlier = self._earlier(pair, estimate)
        with_rig_error = covariance_rect + self._rig_error.at(estimate.T_odom_rect, estimate.distance_m)
        T_odom_rig = self._T_rig_rect @ estimate.T_odom_rect @ se3.inverse(self._T_rig_rect)
        return OdometryUpdate(
            pair.seq,
            pair.stamp_ns,
            T_odom_rig,
            self._in_rig(with_rig_error),
            self._to_rig @ estimate.velocity,
            self._in_rig(estimate.velocity_covariance),
            _state(estimate.state, pair, self.conflict),
            estimate.resets,
            estimate.inliers,
            estimate.tracked,
            StereoDepth(pair, _moving(estimate.exposure), earlier),
            estimate.features,
            pair.light,
            pair.motion,
            estimate.is_keyframe,
            self._agreement.result,
            estimate.image_fault,
            estimate.T_odom_rect,
            covariance_rect,
        )

    def complete(self) -> None:
        """Finish the work for the last pair now, such as its keyframe; otherwise that is done before the next pair."""
        self._method.complete()

    def _earlier(self, pair: Panoramas, estimate: OdometryEstimate) -> EarlierView | None:
        """Return the view at the last keyframe, with the motion since; keep the pair for later ones if it is one."""
        is_known = estimate.state is TrackingState.TRACKING
        before = self._keyframe
        if estimate.is_keyframe:
            self._keyframe = _LastKeyframe(pair.lower, pair.usable, estimate) if is_known else None
        if before is None or not is_known or before.estimate.resets != estimate.resets:
            return None
        T_earlier_now = se3.inverse(before.estimate.T_odom_rect) @ estimate.T_odom_rect
        return EarlierView(before.lower, before.usable, T_earlier_now, _moving(before.estimate.exposure))

    def _disparity(self, pair: Panoramas, exposure: Exposure | None) -> NDArray[np.float32]:
        """Return the disparities (H, W) of a pair for a motion during its exposures."""
        return self._dense.points(pair, _moving(exposure)).disparity

    def _contradicted(self, T_odom_rect: Array, stamp_ns: int) -> Array:
        """Return the covariance (6, 6) that contradicting wheels or gyro add to a pose of the rectified frame."""
        T_odom_base, to_rect = T_odom_rect @ se3.inverse(self._T_base_rect), np.linalg.inv(self._to_base)
        covariance = self._contradiction.add(self.conflict, T_odom_base, stamp_ns * S_PER_NS)
        return np.asarray(to_rect @ covariance @ to_rect.T)

    def _in_rig(self, covariance: Array) -> Array:
        """Return the covariance (6, 6) of a small motion of the rectified frame as one of the rig frame."""
        return np.asarray(self._to_rig @ covariance @ self._to_rig.T)


class _LastKeyframe(NamedTuple):
    """The last keyframe whose pose was known well; without the rest of its pair, such as the dense depth."""

    lower: PaddedPanorama
    usable: NDArray[np.bool_]  # (H, W)
    estimate: OdometryEstimate


def _moving(exposure: Exposure | None) -> Exposure | None:
    """Return the exposure of a frame, None where all its pixels are exposed at the stamp."""
    return None if exposure is None or exposure.times.is_at_once else exposure


def _state(state: TrackingState, pair: Panoramas, conflict: Conflict) -> TrackingState:
    """Return the state of a pose: at best DEGRADED where it is too dark, or wheels and gyro contradict the images."""
    is_doubtful = pair.light.is_too_dark or (conflict.is_fault and conflict.contradicts_images)
    return TrackingState.DEGRADED if state is TrackingState.TRACKING and is_doubtful else state


def _method(
    model: StereoModel,
    config: OdometryConfig,
    raw_images: tuple[RawImage, RawImage] | None,
    motion: MotionFilter,
) -> OdometryMethod:
    if config.method == "default":
        return VisualOdometry(model, config.klt, config.limits, Relocaliser(model), raw_images, motion)
    from omnid.core.odometry.paper.paper_odometry import PaperOdometry  # imported only where it is used

    return PaperOdometry(model, config.klt, config.tracker, config.reference)
