"""The state of the odometry: one enum for numerics, messages, safety rules, status and logs. Imports no numpy."""

from __future__ import annotations

from enum import StrEnum


class TrackingState(StrEnum):
    """How far a pose can be trusted. The values are the words used on the bus, in logs and in the terminal."""

    TRACKING = "tracking"  # enough landmarks agree with the pose
    DEGRADED = "degraded"  # few landmarks, or the first pose after a gap
    LOST = "lost"  # the pose is only predicted and its covariance grows
