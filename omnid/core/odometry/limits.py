"""Limits of the odometry: landmarks wanted, and the support below which a pose is degraded or refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from omnid.errors import OmnidError


@dataclass(frozen=True, slots=True)
class OdometryLimits:
    """Number of landmarks and keyframes, and the thresholds of the acceptance test and of the tracking state."""

    features: Annotated[int, Meta(ge=20, le=10_000), "landmarks wanted in a keyframe"] = 500
    refresh: Annotated[
        float, Meta(ge=0, le=1), "a keyframe is added when less than this share of the last one's landmarks is left"
    ] = 0.9
    # Defaults of times lie in the middle between two pairs at 10 Hz, so that the jitter of stamps changes nothing.
    sparse_s: Annotated[
        float, Meta(ge=0, le=100), "time after which a keyframe is added where the features wanted are not reached, s"
    ] = 0.45
    keyframes: Annotated[int, Meta(ge=1, le=50), "keyframes in the local map; 1: frame to frame"] = 8
    min_inliers: Annotated[int, Meta(ge=4, le=10_000), "inliers below which a pose is refused"] = 20
    min_inlier_ratio: Annotated[
        float,
        Meta(ge=0, le=1),
        "inliers, as a share of the tracked landmarks, below which a pose is refused; likewise those that the upper "
        "camera shows, as a share of the inliers",
    ] = 0.4
    good_inliers: Annotated[int, Meta(ge=4, le=10_000), "inliers below which a pose is degraded"] = 50
    good_inlier_ratio: Annotated[
        float,
        Meta(ge=0, le=1),
        "inlier ratio below which other yaw angles are tried, and share of the inliers in the upper camera below which "
        "a pose is degraded",
    ] = 0.6
    max_speed_mps: Annotated[float, Meta(ge=0.1, le=100), "poses that imply a higher speed are refused, m/s"] = 5.0
    lost_s: Annotated[
        float, Meta(ge=0, le=100), "time from the first of consecutive refused frames after which the state is lost, s"
    ] = 0.15
    restart_s: Annotated[
        float,
        Meta(ge=0, le=1000),
        "time from the first frame with enough corners that matches no landmark while lost, after which the map is "
        "started again, s",
    ] = 0.85
    max_gap_s: Annotated[float, Meta(ge=0.01, le=60), "a pose after a longer time without frames is degraded, s"] = 0.5
    bridge_s: Annotated[
        float,
        Meta(ge=0, le=600),
        "longest time for which wheels and gyro carry the pose on while the cameras show "
        "nothing, as degraded; 0: never, s",
    ] = 10.0
    bridge_sigma_m: Annotated[
        float, Meta(ge=0.001, le=10), "uncertainty of the position that ends that, standard deviation, m"
    ] = 0.15

    def __post_init__(self) -> None:
        """Raise OmnidError unless a keyframe may have more landmarks than a pose needs."""
        if self.min_inliers >= self.features:
            raise OmnidError(
                f"odometry.limits.min_inliers is {self.min_inliers}: expected less than odometry.limits.features, "
                f"{self.features}, as no pose has more inliers than a keyframe has landmarks"
            )
