"""Poses on the floor (x, y, yaw) of Python floats: composition, inverse, motion on an arc.

This module loads no numpy, because the process that steers the base uses it. Arrays of poses: `se2_arrays.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

Point = tuple[float, float]


class Pose2(NamedTuple):
    """A pose on the floor; also the motion from one pose to another, in the axes of the first."""

    x_m: float
    y_m: float
    yaw_rad: float


IDENTITY: Final = Pose2(0.0, 0.0, 0.0)


def composed(first: Pose2, then: Pose2) -> Pose2:
    """Return the pose `then`, which is given in the axes of `first`, in the frame of `first`."""
    c, s = math.cos(first.yaw_rad), math.sin(first.yaw_rad)
    return Pose2(
        first.x_m + c * then.x_m - s * then.y_m, first.y_m + s * then.x_m + c * then.y_m, first.yaw_rad + then.yaw_rad
    )


def relative(first: Pose2, second: Pose2) -> Pose2:
    """Return the second pose in the axes of the first."""
    ((x_m, y_m),) = seen_from(first, [(second.x_m, second.y_m)])
    return Pose2(x_m, y_m, second.yaw_rad - first.yaw_rad)


def seen_from(pose: Pose2, points: Iterable[Point]) -> list[Point]:
    """Return points [m] in the axes of a pose."""
    px, py, c, s = pose.x_m, pose.y_m, math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return [(c * (x - px) + s * (y - py), c * (y - py) - s * (x - px)) for x, y in points]


def along_arc(velocity_mps: float, yaw_rate_radps: float, duration_s: float) -> Pose2:
    """Return the motion at constant speeds during a time: along the chord of the arc, at half of the turn."""
    turn_rad = yaw_rate_radps * duration_s
    chord_m = velocity_mps * duration_s
    if turn_rad:
        chord_m *= 2 * math.sin(turn_rad / 2) / turn_rad
    return Pose2(chord_m * math.cos(turn_rad / 2), chord_m * math.sin(turn_rad / 2), turn_rad)
