"""Results of the odometry, and its limits: the pose that a frame supports, and the estimate that is published."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from omnid.core.odometry.exposure_times import NO_VELOCITY, Exposure, RigVelocity
from omnid.core.odometry.stereo_frame import Features
from omnid.tracking_state import TrackingState


@dataclass(frozen=True, slots=True)
class OdometryLimits:
    """Number of landmarks and keyframes, and the thresholds of the acceptance test and of the tracking state."""

    features: Annotated[int, Meta(ge=40, le=10_000), "landmarks wanted in a keyframe"] = 500
    refresh: float = 0.9  # a keyframe is added when less than this share of the last one's landmarks is left
    # Defaults of times lie in the middle between two pairs at 10 Hz, so that the jitter of stamps changes nothing.
    sparse_s: float = 0.45  # time after which a keyframe is added where the features wanted are not reached, s
    keyframes: Annotated[int, Meta(ge=2, le=50), "keyframes in the local map"] = 8
    min_inliers: int = 20  # inliers below which a pose is refused
    # inliers, as a share of the tracked landmarks, below which a pose is refused; likewise those that the upper
    # camera shows, as a share of the inliers
    min_inlier_ratio: float = 0.4
    good_inliers: int = 50  # inliers below which a pose is degraded
    # inlier ratio below which other yaw angles are tried, and share of the inliers in the upper camera below which a
    # pose is degraded
    good_inlier_ratio: float = 0.6
    max_speed_mps: Annotated[float, Meta(ge=0.1, le=100), "poses that imply a higher speed are refused, m/s"] = 5.0
    restart_s: float = 1.05  # time of frames with texture that matched nothing, after which the map is started again, s
    max_gap_s: Annotated[float, Meta(ge=0.01, le=60), "a pose after a longer time without frames is degraded, s"] = 0.5
    bridge_s: Annotated[
        float,
        Meta(ge=0, le=600),
        "time after which the pose is lost while the cameras show nothing, although wheels and gyro carry it on, s",
    ] = 10.0
    # growth of the position's standard deviation since the cameras found it, above which the pose is lost: that of a
    # quarter of a second that nothing measures
    bridge_sigma_m: float = 0.125


Array = NDArray[np.float64]

ROOM_M = 2.0  # median distance of landmarks that are not known: in a room
SAME_M = 0.02  # Poses that differ less are one, because four sigmas of a pose that few landmarks support are as large.


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """Pose of a frame in odom with its covariance, and the number of landmarks predicted, tracked and inliers.

    The covariance takes the keyframes of the local map as exact.
    """

    T_odom_rect: Array
    covariance: Array  # (6, 6) [t; r] in the rectified frame
    visible: int  # landmarks that the guessed pose predicts in the panorama
    tracked: int
    inliers: int
    landmarks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))  # (M,) rows of the local map
    views: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (M, 3) px of them at the stamp, NaN: not in upper
    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (M, 2) px of them in the lower panorama
    variance: Array = field(default_factory=lambda: np.zeros(0))  # (M,) px^2 of the disparity of each view
    # (M, 6, 6) derivatives of the pose by a motion of each of them, both [t; r] in the rectified frame
    by_landmark: Array = field(default_factory=lambda: np.zeros((0, 6, 6)))
    rejected: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (K, 2) px of tracked landmarks, no inliers
    # (M, K) px by m/s and rad/s: derivatives of the disparities by the velocity, and the one that was assumed.
    by_motion: Array = field(default_factory=lambda: np.zeros((0, 0)))
    assumed: RigVelocity = NO_VELOCITY
    # Mean cost of a landmark in view: half of the Cauchy kernel's value, by the landmarks that count as one.
    cost: float = 0.0
    in_view: int = 0  # landmarks by which it is meant
    upper_ratio: float = 1.0  # share of the inliers among the tracks that the upper panorama shows where they must be

    def distance_m(self, T_odom_rect: Array) -> float:
        """Return the distance [m] of the pose from another one (4, 4)."""
        return float(np.linalg.norm(self.T_odom_rect[:3, 3] - T_odom_rect[:3, 3]))

    @property
    def inlier_ratio(self) -> float:
        """Share of the tracked landmarks that are inliers."""
        return self.inliers / max(1, self.tracked)

    def has_support(self, limits: OdometryLimits) -> bool:
        """True if the pose has enough inliers in both cameras."""
        return self.inliers >= limits.min_inliers and self.least_ratio >= limits.min_inlier_ratio

    @property
    def least_ratio(self) -> float:
        """The inlier ratio, or the share in the upper panorama if that is smaller.

        The lower camera alone would confirm the pose of images that were not taken at one time, or are exchanged.
        """
        return min(self.inlier_ratio, self.upper_ratio)


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """Pose T_odom_rect after a frame and its quality; covariances in the axes of the rectified frame, [t; r]."""

    T_odom_rect: Array
    covariance: Array  # (6, 6) m^2, rad^2
    velocity: Array  # (6,) m/s, rad/s
    velocity_covariance: Array
    state: TrackingState
    resets: int
    tracked: int
    inliers: int
    features: Features = field(default_factory=Features)
    step: Array | None = None  # T_prev_curr (4, 4) by the cameras alone; None: a break, or it is in doubt
    is_keyframe: bool = False  # dense stereo of the frame is computed for the local map
    image_fault: str = ""  # how the images of a camera are torn or displaced, see image_breaks.py; empty: they are not
    # The motion during the exposures, for dense stereo of the frame; None: not known.
    exposure: Exposure | None = None
    distance_m: float = ROOM_M  # median of the landmarks
