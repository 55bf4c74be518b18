"""Limits of the odometry: landmarks wanted, and the support below which a pose is degraded or refused."""

from __future__ import annotations

from dataclasses import dataclass

from omnid.errors import OmnidError
from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class OdometryLimits:
    """Number of landmarks and keyframes, and the thresholds of the acceptance test and of the tracking state."""

    features: int = knob(500, "landmarks wanted in a keyframe", low=20, high=10_000)
    refresh: float = knob(
        0.9, "a keyframe is added when less than this share of the last one's landmarks is left", low=0, high=1
    )
    # Defaults of times lie in the middle between two pairs at 10 Hz, so that the jitter of stamps changes nothing.
    sparse_s: float = knob(
        0.45, "time after which a keyframe is added where the features wanted are not reached, s", low=0, high=100
    )
    keyframes: int = knob(8, "keyframes in the local map; 1: frame to frame", low=1, high=50)
    min_inliers: int = knob(20, "inliers below which a pose is refused", low=4, high=10_000)
    min_inlier_ratio: float = knob(
        0.4,
        "inliers, as a share of the tracked landmarks, below which a pose is refused; likewise those that the upper "
        "camera shows, as a share of the inliers",
        low=0,
        high=1,
    )
    good_inliers: int = knob(50, "inliers below which a pose is degraded", low=4, high=10_000)
    good_inlier_ratio: float = knob(
        0.6,
        "inlier ratio below which other yaw angles are tried, and share of the inliers in the upper camera below which "
        "a pose is degraded",
        low=0,
        high=1,
    )
    max_speed_mps: float = knob(5.0, "poses that imply a higher speed are refused, m/s", low=0.1, high=100)
    lost_s: float = knob(
        0.15, "time from the first of consecutive refused frames after which the state is lost, s", low=0, high=100
    )
    restart_s: float = knob(
        0.85,
        "time from the first frame with enough corners that matches no landmark while lost, after which the map is "
        "started again, s",
        low=0,
        high=1000,
    )
    max_gap_s: float = knob(0.5, "a pose after a longer time without frames is degraded, s", low=0.01, high=60)
    bridge_s: float = knob(
        10.0,
        "longest time for which wheels and gyro carry the pose on while the cameras show "
        "nothing, as degraded; 0: never, s",
        low=0,
        high=600,
    )
    bridge_sigma_m: float = knob(
        0.15, "uncertainty of the position that ends that, standard deviation, m", low=0.001, high=10
    )

    def __post_init__(self) -> None:
        """Raise OmnidError unless a keyframe may have more landmarks than a pose needs."""
        if self.min_inliers >= self.features:
            raise OmnidError(
                f"odometry.limits.min_inliers is {self.min_inliers}: expected less than odometry.limits.features, "
                f"{self.features}, as no pose has more inliers than a keyframe has landmarks"
            )
