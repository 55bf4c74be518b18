"""State of the odometry: one enum for numerics, messages, safety rules, status and logs. Imports no numpy."""

from __future__ import annotations

from enum import StrEnum


class TrackingState(StrEnum):
    """Trust in a pose. The values are the words used on the bus, in logs and in the terminal."""

    TRACKING = "tracking"  # the pose has enough inliers
    DEGRADED = "degraded"  # few inliers, the first pose after a gap, a refused frame, or one that wheels contradict
    LOST = "lost"  # the pose is only predicted and its covariance grows


class MapState(StrEnum):
    """Trust in the pose in the map."""

    LOCALIZED = "localized"  # a place was recognised lately
    ODOMETRY_ONLY = "odometry only"  # the pose in the map is that of odometry since the last place, or since the start
    LOST = "lost"  # odometry is lost, and the pose in the map with it
