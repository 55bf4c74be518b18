"""CDR of the messages of the navigation: goals, paths and strings."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport import ros_types as ros

PATH_SCHEMA: Final = "nav_msgs/msg/Path"
STRING_SCHEMA: Final = "std_msgs/msg/String"
MAX_PATH_POSES: Final = 10_000
_MOST_TILT: Final = 0.05  # Largest x and y of a quaternion that counts as a turn about z: a tilt of 6 degrees.


class PlanarGoal(NamedTuple):
    """Content of a PoseStamped on the floor."""

    stamp_ns: int
    frame: str
    x_m: float
    y_m: float
    heading_rad: float | None  # None: the quaternion is all zeros, which asks for no heading


class PlanarPath(NamedTuple):
    """Content of a Path on the floor."""

    stamp_ns: int
    frame: str
    xy: NDArray[np.float64]  # (N, 2) m
    heading_rad: float | None  # of the last pose; None: its quaternion is all zeros


def goal_cdr(goal: PlanarGoal) -> bytes:
    """Encode a goal as a PoseStamped."""
    pose = _pose(goal.x_m, goal.y_m, goal.heading_rad)
    return codec.message_cdr(
        ros.geometry_msgs__msg__PoseStamped(codec.header_message(goal.stamp_ns, goal.frame), pose), codec.POSE_SCHEMA
    )


def goal_from_cdr(payload: bytes) -> PlanarGoal:
    """Decode a PoseStamped. Raise OmnidError for other bytes, numbers that are not finite, and a tilted pose."""
    message = codec.message_from_cdr(payload, codec.POSE_SCHEMA)
    assert isinstance(message, ros.geometry_msgs__msg__PoseStamped)
    x_m, y_m = _position(message.pose)
    stamp_ns = codec.unchecked_stamp_ns(message.header.stamp)
    return PlanarGoal(stamp_ns, message.header.frame_id, x_m, y_m, _heading(message.pose))


def path_cdr(stamp_ns: int, frame: str, xy: ArrayLike, heading_rad: float | None = None) -> bytes:
    """Encode a path through positions (N, 2); its poses point along it, the last one to the given heading."""
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    steps = np.diff(points, axis=0, append=points[-1:])
    headings: list[float | None] = [float(math.atan2(dy, dx)) for dx, dy in steps]
    headings[-1:] = [heading_rad]
    header = codec.header_message(stamp_ns, frame)
    poses = [
        ros.geometry_msgs__msg__PoseStamped(header, _pose(float(x), float(y), heading))
        for (x, y), heading in zip(points, headings, strict=True)
    ]
    return codec.message_cdr(ros.nav_msgs__msg__Path(header, poses), PATH_SCHEMA)


def path_from_cdr(payload: bytes) -> PlanarPath:
    """Decode a path of 1 to MAX_PATH_POSES poses. Raise OmnidError as goal_from_cdr."""
    message = codec.message_from_cdr(payload, PATH_SCHEMA)
    assert isinstance(message, ros.nav_msgs__msg__Path)
    if not 1 <= len(message.poses) <= MAX_PATH_POSES:
        raise OmnidError(f"a path of {len(message.poses)} poses: expected 1 to {MAX_PATH_POSES}")
    xy = np.array([_position(entry.pose) for entry in message.poses])
    stamp_ns = codec.unchecked_stamp_ns(message.header.stamp)
    return PlanarPath(stamp_ns, message.header.frame_id, xy, _heading(message.poses[-1].pose))


def string_cdr(text: str) -> bytes:
    """Encode a std_msgs/msg/String."""
    return codec.message_cdr(ros.std_msgs__msg__String(text), STRING_SCHEMA)


def string_from_cdr(payload: bytes) -> str:
    """Decode a String. Raise OmnidError for any other bytes."""
    message = codec.message_from_cdr(payload, STRING_SCHEMA)
    assert isinstance(message, ros.std_msgs__msg__String)
    return message.data


def _pose(x_m: float, y_m: float, heading_rad: float | None) -> ros.geometry_msgs__msg__Pose:
    half_rad = 0.0 if heading_rad is None else 0.5 * heading_rad
    w = 0.0 if heading_rad is None else math.cos(half_rad)
    quaternion = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, math.sin(half_rad), w)
    return ros.geometry_msgs__msg__Pose(ros.geometry_msgs__msg__Point(x_m, y_m, 0.0), quaternion)


def _position(pose: ros.geometry_msgs__msg__Pose) -> tuple[float, float]:
    if not (math.isfinite(pose.position.x) and math.isfinite(pose.position.y)):
        raise OmnidError("a position is not finite; check the sender")
    return pose.position.x, pose.position.y


def _heading(pose: ros.geometry_msgs__msg__Pose) -> float | None:
    q = (pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w)
    if not any(q):
        return None
    if not abs(math.hypot(*q) - 1.0) < codec.QUATERNION_TOLERANCE or max(abs(q[0]), abs(q[1])) > _MOST_TILT:
        raise OmnidError(f"orientation {q}: expected a unit quaternion about z, or all zeros; check the sender")
    return float(se3.yaw(se3.transform(se3.rotation(q), (0.0, 0.0, 0.0))))
