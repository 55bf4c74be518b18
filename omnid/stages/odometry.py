"""Odometry stage: poses of the rectified frame become poses of the rig, and of the base."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import OdometryConfig
from omnid.core.odometry.estimates import OdometryEstimate
from omnid.core.odometry.exposure_times import Exposure, RigVelocity
from omnid.core.odometry.motion_sensors import MotionSensors
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.relocalisation import Relocaliser
from omnid.messages import OdometryUpdate, StereoDepth
from omnid.stages.geometry import Geometry, GeometryVersions
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]


def all_features() -> float:
    """Return 1."""
    return 1.0


class OdometryMethod(Protocol):
    """A method that estimates the pose of the rectified frame from pair to pair."""

    def process(self, frame: StereoFrame, dt_s: float) -> OdometryEstimate:
        """Return the pose at a frame, dt_s [s] after the previous one (0 for the first)."""

    def complete(self) -> None:
        """Do what is left to do for the last frame; otherwise `process` does it before the next one."""


@dataclass(frozen=True, slots=True)
class _Start:
    """The pose at which a version of the geometry begins."""

    T_odom_rig: Array  # (4, 4)
    covariance: Array  # (6, 6) in the axes of the rig
    resets: int


class OdometryStage:
    """Estimate poses in odom, which is the rig frame of the first pair.

    A new version of the geometry begins while the robot stands: the local map begins again at the last pose, which is
    then known as well as before.
    """

    def __init__(self, geometry: Geometry | GeometryVersions, config: OdometryConfig,
                 features: Callable[[], float] = all_features) -> None:
        """features: called for each keyframe, the share of the landmarks that it is to have."""
        self._versions = geometry if isinstance(geometry, GeometryVersions) else GeometryVersions(geometry)
        self._config, self._features = config, features
        self._newest = _Start(np.eye(4), np.zeros((6, 6)), 0)
        self._use(0)
        # A refined rig differs so little that the wheels do not notice.
        self.sensors = MotionSensors(se3.inverse(self._versions[0].rig.T_base_rig @ self._T_rig_rect))

    def _use(self, version: int) -> None:
        """Begin at the last pose with a version of the geometry."""
        geometry, self._version, self._start = self._versions[version], version, self._newest
        self._model = geometry.model(self._config.noise_px)
        self._method = _method(self._model, self._config, self._features)
        self._T_rig_rect = geometry.T_rig_rect
        self._to_rig = se3.adjoint(self._T_rig_rect)
        self._last_ns: int | None = None

    def process(self, depth: StereoDepth) -> OdometryUpdate:
        """Return the pose at a pair."""
        if depth.panoramas.rig_version != self._version:
            self._use(depth.panoramas.rig_version)
        last_ns, self._last_ns = self._last_ns, depth.stamp_ns
        dt_s = 0.0 if last_ns is None else (depth.stamp_ns - last_ns) * 1e-9
        pair = depth.panoramas
        self.sensors.add(pair.motion)
        sensed = None if last_ns is None else self.sensors.between(last_ns, depth.stamp_ns)
        usable = np.zeros_like(pair.visible) if pair.light.shows_nothing else pair.visible
        frame = StereoFrame(depth.seq, pair.lower, pair.upper, depth.disparity_at, usable, pair.times, sensed)
        estimate = self._method.process(frame, dt_s)
        if estimate.step is not None and last_ns is not None:
            self.sensors.observe(*estimate.step, last_ns, depth.stamp_ns)
        motion = RigVelocity(estimate.velocity, estimate.velocity_covariance)
        if estimate.keyframe_exposure is not None:
            depth.settle(estimate.keyframe_exposure, again=True)
        else:
            depth.settle(None if pair.times is None else Exposure(pair.times, motion, self._model))
        T_start_rig = self._T_rig_rect @ estimate.T_odom_rect @ se3.inverse(self._T_rig_rect)
        since_start = se3.adjoint(se3.inverse(T_start_rig))
        covariance = since_start @ self._start.covariance @ since_start.T + self._in_rig(estimate.covariance)
        newest = self._newest = _Start(self._start.T_odom_rig @ T_start_rig, covariance,
                                       self._start.resets + estimate.resets)
        return OdometryUpdate(
            depth.seq, depth.stamp_ns, newest.T_odom_rig, in_axes(newest.T_odom_rig, covariance),
            self._to_rig @ estimate.velocity, self._in_rig(estimate.velocity_covariance),
            _state(estimate.state, depth), newest.resets, estimate.inliers, estimate.tracked, depth,
            estimate.features, depth.panoramas.light, pair.motion, estimate.is_keyframe,
        )

    def after(self) -> None:
        """Make the keyframe of the last pair, whose pose was passed on, if there is to be one."""
        self._method.complete()

    def _in_rig(self, covariance: Array) -> Array:
        """Return the covariance (6, 6) of a small motion of the rectified frame as one of the rig frame."""
        return np.asarray(self._to_rig @ covariance @ self._to_rig.T)


def _state(state: TrackingState, depth: StereoDepth) -> TrackingState:
    """Return the state of a pose: at best DEGRADED where the images contradict the rig, and where it is too dark."""
    doubtful = not depth.rig_fits or depth.panoramas.light.is_too_dark
    return TrackingState.DEGRADED if state is TrackingState.TRACKING and doubtful else state


def in_axes(T_a_b: Array, covariance: Array) -> Array:
    """Return the covariance (6, 6) [t; r] of a pose T_a_b, given in the axes of b, in the axes of a."""
    R = np.zeros((6, 6))
    R[:3, :3] = R[3:, 3:] = T_a_b[:3, :3]
    return np.asarray(R @ covariance @ R.T)


def of_base(odometry: OdometryUpdate, T_base_rig: Array) -> tuple[Array, Array, Array, Array]:
    """Return T_odom_base of the base that carries the rig, its covariance in odom axes, velocity and its covariance.

    odom is here the base's frame at the first pair; the velocity is in the base frame.
    """
    A = se3.adjoint(T_base_rig)
    T_odom_base, covariance = base_pose(odometry.T_odom_rig, odometry.covariance, T_base_rig)
    return T_odom_base, covariance, A @ odometry.velocity, A @ odometry.velocity_covariance @ A.T


def base_pose(T_odom_rig: Array, covariance: Array, T_base_rig: Array) -> tuple[Array, Array]:
    """Return the pose of the base and its covariance, for those of the rig; axes as in of_base."""
    A = se3.adjoint(T_base_rig)
    T_odom_base = T_base_rig @ T_odom_rig @ se3.inverse(T_base_rig)
    return T_odom_base, in_axes(T_odom_base, A @ in_axes(se3.inverse(T_odom_rig), covariance) @ A.T)


def _method(model: StereoModel, config: OdometryConfig, features: Callable[[], float]) -> OdometryMethod:
    if config.method == "default":
        return VisualOdometry(model, config.klt, config.limits, Relocaliser(model), features)
    from omnid.core.odometry.paper.paper_odometry import PaperOdometry  # imported only where it is used

    return PaperOdometry(model, config.klt, config.tracker, config.reference)
