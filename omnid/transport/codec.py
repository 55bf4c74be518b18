"""Encoding and decoding of ROS 2 (Humble) messages as CDR bytes, by rosbags; the same for recordings and the bus.

Arrays in SI units; p_a = T_a_b @ p_b; covariances in the order x y z rx ry rz, row-major (nav_msgs/msg/Odometry).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import ros_types as ros
from omnid.transport.records import DiagnosticStatus, FrameTransform, HeadingRecord, OdometryRecord, TwistRecord

ODOMETRY_SCHEMA = "nav_msgs/msg/Odometry"
IMU_SCHEMA = "sensor_msgs/msg/Imu"
JOINT_SCHEMA = "sensor_msgs/msg/JointState"
POSE_SCHEMA = "geometry_msgs/msg/PoseStamped"
MAP_POSE_SCHEMA = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM_SCHEMA = "tf2_msgs/msg/TFMessage"
POINT_CLOUD_SCHEMA = "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS_SCHEMA = "diagnostic_msgs/msg/DiagnosticArray"
TWIST_SCHEMA = "geometry_msgs/msg/TwistStamped"
PLAIN_TWIST_SCHEMA = "geometry_msgs/msg/Twist"
VECTOR_SCHEMA = "geometry_msgs/msg/Vector3Stamped"
GRID_SCHEMA = "nav_msgs/msg/OccupancyGrid"
HEADER_SCHEMA = "std_msgs/msg/Header"
CLOCK_SCHEMA = "rosgraph_msgs/msg/Clock"
BOOL_SCHEMA = "std_msgs/msg/Bool"
_PLAIN_TWIST_BYTES = 4 + 6 * 8  # encapsulation header, two vectors
# Types whose serialisers are compiled at the start of a run, see compile_serialisers.
SCHEMAS = (
    ODOMETRY_SCHEMA,
    POSE_SCHEMA,
    MAP_POSE_SCHEMA,
    TRANSFORM_SCHEMA,
    POINT_CLOUD_SCHEMA,
    DIAGNOSTICS_SCHEMA,
    TWIST_SCHEMA,
    VECTOR_SCHEMA,
    GRID_SCHEMA,
    HEADER_SCHEMA,
    CLOCK_SCHEMA,
)

# A quaternion whose norm differs from 1 by more than this is refused: more than rounding to float32 or to six decimals
# makes, and less than a quaternion of zeros or one that was scaled.
QUATERNION_TOLERANCE = 1e-3
NS_PER_S = 1_000_000_000
MAX_SECONDS = 2**31 - 1  # builtin_interfaces/msg/Time counts seconds in an int32

Array = NDArray[np.float64]
Frames = tuple[str, str]
Cartesian: TypeAlias = (
    "ros.geometry_msgs__msg__Vector3 | ros.geometry_msgs__msg__Point | ros.geometry_msgs__msg__Quaternion"
)


OK, WARN, ERROR, STALE = range(4)  # levels of diagnostic_msgs/msg/DiagnosticStatus


@cache
def _typestore() -> Typestore:
    """Return the message definitions; made at first use, because their serialisers are compiled then."""
    return get_typestore(Stores.ROS2_HUMBLE)


def compile_serialisers(*more: str) -> None:
    """Compile all serialisers now: compilation at first use would delay all threads, that of the motor included."""
    for schema in (*SCHEMAS, *more):
        _typestore().get_msgdef(schema)


def message_cdr(message: object, schema: str) -> bytes:
    """Encode a message in the type of rosbags."""
    return bytes(_typestore().serialize_cdr(message, schema))


def ros_time(stamp_ns: int) -> tuple[int, int]:
    """Return seconds and nanoseconds of a stamp. Raise OmnidError for one that is no ROS time."""
    seconds, nanoseconds = divmod(int(stamp_ns), NS_PER_S)
    if not 0 <= seconds <= MAX_SECONDS:
        raise OmnidError(f"stamp {stamp_ns} ns does not fit a ROS time (1970 to 2038); give nanoseconds of Unix time")
    return seconds, nanoseconds


def time_message(stamp_ns: int) -> ros.builtin_interfaces__msg__Time:
    """Return a stamp. Raise OmnidError for one that is no ROS time."""
    return ros.builtin_interfaces__msg__Time(*ros_time(stamp_ns))


def header_message(stamp_ns: int, frame: str) -> ros.std_msgs__msg__Header:
    """Return a header. Raise OmnidError for a stamp that is no ROS time."""
    return ros.std_msgs__msg__Header(time_message(stamp_ns), frame)


def _vector(xyz: ArrayLike) -> ros.geometry_msgs__msg__Vector3:
    return ros.geometry_msgs__msg__Vector3(*(float(v) for v in np.asarray(xyz)))


def _quaternion(R: ArrayLike) -> ros.geometry_msgs__msg__Quaternion:
    return ros.geometry_msgs__msg__Quaternion(*_xyzw(np.asarray(R, np.float64).tobytes()))


@lru_cache(maxsize=8)
def _xyzw(R: bytes) -> list[float]:
    """Return the quaternion of a rotation; cached because several messages carry the same pose."""
    return list(se3.quaternion(np.frombuffer(R).reshape(3, 3)).tolist())


def pose_message(T: Array) -> ros.geometry_msgs__msg__Pose:
    """Return the message of a transform (4, 4)."""
    position = ros.geometry_msgs__msg__Point(*(float(v) for v in T[:3, 3]))
    return ros.geometry_msgs__msg__Pose(position, _quaternion(T[:3, :3]))


def _covariance(matrix: ArrayLike) -> Array:
    """Return a covariance (6, 6) as the array (36,) of a message. Raise OmnidError for another shape."""
    flat = np.ascontiguousarray(matrix, np.float64).reshape(-1)
    if flat.shape != (36,):
        raise OmnidError(f"covariance of shape {np.shape(matrix)}: expected (6, 6), in the order x y z rx ry rz")
    return flat


def odometry_cdr(
    stamp_ns: int,
    T_odom_base: Array,
    covariance: Array,
    velocity: Array,
    velocity_covariance: Array,
    frames: Frames = ("odom", "base_link"),
) -> bytes:
    """Encode a nav_msgs/msg/Odometry: pose in the parent frame, velocity (6,) [m/s, rad/s] in the child frame."""
    parent, child = frames
    twist = ros.geometry_msgs__msg__Twist(_vector(velocity[:3]), _vector(velocity[3:]))
    message = ros.nav_msgs__msg__Odometry(
        header_message(stamp_ns, parent),
        child,
        ros.geometry_msgs__msg__PoseWithCovariance(pose_message(T_odom_base), _covariance(covariance)),
        ros.geometry_msgs__msg__TwistWithCovariance(twist, _covariance(velocity_covariance)),
    )
    return message_cdr(message, ODOMETRY_SCHEMA)


def pose_stamped_cdr(stamp_ns: int, T_odom_body: Array) -> bytes:
    """Encode a geometry_msgs/msg/PoseStamped: the pose of a body in odom."""
    message = ros.geometry_msgs__msg__PoseStamped(header_message(stamp_ns, "odom"), pose_message(T_odom_body))
    return message_cdr(message, POSE_SCHEMA)


def pose_with_covariance_cdr(stamp_ns: int, T_map_body: Array, covariance: Array) -> bytes:
    """Encode a geometry_msgs/msg/PoseWithCovarianceStamped: the pose of a body in the map, covariance in its axes."""
    pose = ros.geometry_msgs__msg__PoseWithCovariance(pose_message(T_map_body), _covariance(covariance))
    message = ros.geometry_msgs__msg__PoseWithCovarianceStamped(header_message(stamp_ns, "map"), pose)
    return message_cdr(message, MAP_POSE_SCHEMA)


def transform_cdr(stamp_ns: int, transforms: Sequence[FrameTransform]) -> bytes:
    """Encode a tf2_msgs/msg/TFMessage: edges of the frame tree, all of one instant."""
    edges = [_edge(stamp_ns, edge) for edge in transforms]
    return message_cdr(ros.tf2_msgs__msg__TFMessage(edges), TRANSFORM_SCHEMA)


def _edge(stamp_ns: int, edge: FrameTransform) -> ros.geometry_msgs__msg__TransformStamped:
    T = edge.T_parent_child
    motion = ros.geometry_msgs__msg__Transform(_vector(T[:3, 3]), _quaternion(T[:3, :3]))
    return ros.geometry_msgs__msg__TransformStamped(header_message(stamp_ns, edge.parent), edge.child, motion)


def diagnostics_cdr(stamp_ns: int, statuses: Sequence[DiagnosticStatus]) -> bytes:
    """Encode a diagnostic_msgs/msg/DiagnosticArray."""
    entries = [_status(status) for status in statuses]
    return message_cdr(
        ros.diagnostic_msgs__msg__DiagnosticArray(header_message(stamp_ns, ""), entries), DIAGNOSTICS_SCHEMA
    )


def _status(status: DiagnosticStatus) -> ros.diagnostic_msgs__msg__DiagnosticStatus:
    if not 0 <= status.level <= 3:
        raise OmnidError(
            f"diagnostic level {status.level} of {status.name}: expected 0 (ok), 1 (warning), 2 (error) or 3 (stale)"
        )
    pairs = [ros.diagnostic_msgs__msg__KeyValue(key, value) for key, value in status.values.items()]
    return ros.diagnostic_msgs__msg__DiagnosticStatus(status.level, status.name, status.message, "", pairs)


def twist_stamped_cdr(stamp_ns: int, frame: str, linear_mps: float, yaw_rate_radps: float) -> bytes:
    """Encode a geometry_msgs/msg/TwistStamped of a ground robot: forward speed and yaw rate in `frame`."""
    twist = ros.geometry_msgs__msg__Twist(_vector((linear_mps, 0, 0)), _vector((0, 0, yaw_rate_radps)))
    return message_cdr(ros.geometry_msgs__msg__TwistStamped(header_message(stamp_ns, frame), twist), TWIST_SCHEMA)


def heading_cdr(stamp_ns: int, velocity_mps: float, heading_rad: float) -> bytes:
    """Encode a heading command, a geometry_msgs/msg/Vector3Stamped in odom: x is the speed, z the heading."""
    vector = _vector((velocity_mps, 0, heading_rad))
    return message_cdr(ros.geometry_msgs__msg__Vector3Stamped(header_message(stamp_ns, "odom"), vector), VECTOR_SCHEMA)


def twist_from_cdr(payload: bytes) -> TwistRecord:
    """Decode a TwistStamped; its numbers need not be finite. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, TWIST_SCHEMA)
    assert isinstance(message, ros.geometry_msgs__msg__TwistStamped)
    return TwistRecord(
        unchecked_stamp_ns(message.header.stamp),
        message.header.frame_id,
        message.twist.linear.x,
        message.twist.angular.z,
    )


def is_plain_twist(payload: bytes) -> bool:
    """True if a payload has the length of a geometry_msgs/msg/Twist, which no TwistStamped has."""
    return len(payload) == _PLAIN_TWIST_BYTES


def plain_twist_from_cdr(payload: bytes) -> TwistRecord:
    """Decode a Twist, which has no stamp (0) and no frame. Raise OmnidError for any other bytes."""
    twist = message_from_cdr(payload, PLAIN_TWIST_SCHEMA)
    assert isinstance(twist, ros.geometry_msgs__msg__Twist)
    return TwistRecord(0, "", twist.linear.x, twist.angular.z)


def heading_from_cdr(payload: bytes) -> HeadingRecord:
    """Decode a Vector3Stamped; its numbers need not be finite. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, VECTOR_SCHEMA)
    assert isinstance(message, ros.geometry_msgs__msg__Vector3Stamped)
    return HeadingRecord(
        unchecked_stamp_ns(message.header.stamp), message.header.frame_id, message.vector.x, message.vector.z
    )


def clock_cdr(stamp_ns: int) -> bytes:
    """Encode the time of a run, for programs that follow it."""
    return message_cdr(ros.rosgraph_msgs__msg__Clock(time_message(stamp_ns)), CLOCK_SCHEMA)


def header_cdr(stamp_ns: int) -> bytes:
    """Encode a std_msgs/msg/Header, which is the message of cmd/arm."""
    return message_cdr(header_message(stamp_ns, ""), HEADER_SCHEMA)


def stamp_from_cdr(payload: bytes) -> int:
    """Decode the stamp of a Header, ns; it may be invalid. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, HEADER_SCHEMA)
    assert isinstance(message, ros.std_msgs__msg__Header)
    return unchecked_stamp_ns(message.stamp)


def bool_cdr(value: bool) -> bytes:
    """Encode a std_msgs/msg/Bool, which is the message of cmd/bumper and cmd/cliff."""
    return message_cdr(ros.std_msgs__msg__Bool(value), BOOL_SCHEMA)


def bool_from_cdr(payload: bytes) -> bool:
    """Decode a Bool. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, BOOL_SCHEMA)
    assert isinstance(message, ros.std_msgs__msg__Bool)
    return bool(message.data)


def message_from_cdr(payload: bytes, schema: str) -> object:
    """Decode a message of a schema into the type of rosbags. Raise OmnidError for any other bytes."""
    try:
        return _typestore().deserialize_cdr(bytes(payload), schema)
    except SerdeError as error:
        raise OmnidError(f"{len(payload)} bytes are not a {schema} in CDR ({error}); check the sender") from error


def unchecked_stamp_ns(stamp: ros.builtin_interfaces__msg__Time) -> int:
    """Return a stamp that may be invalid; callers check it."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def odometry_from_cdr(payload: bytes) -> OdometryRecord:
    """Decode an Odometry message. Raise OmnidError unless the bytes are one with a finite, rigid pose."""
    message = message_from_cdr(payload, ODOMETRY_SCHEMA)
    assert isinstance(message, ros.nav_msgs__msg__Odometry)
    twist = message.twist.twist
    return OdometryRecord(
        stamp_ns=_stamp_ns(message.header.stamp),
        T_odom_base=rigid_transform(message.pose.pose),
        covariance=message.pose.covariance.reshape(6, 6),
        velocity=np.array([*_xyz(twist.linear), *_xyz(twist.angular)]),
        velocity_covariance=message.twist.covariance.reshape(6, 6),
        frames=(message.header.frame_id, message.child_frame_id),
    )


def _stamp_ns(stamp: ros.builtin_interfaces__msg__Time) -> int:
    """Return the stamp of an Odometry. Raise OmnidError for one that is invalid."""
    if stamp.sec < 0 or stamp.nanosec >= NS_PER_S:
        raise OmnidError(f"odometry stamp {stamp.sec} s {stamp.nanosec} ns: expected Unix time; check the sender")
    return unchecked_stamp_ns(stamp)


def _xyz(vector: Cartesian) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def rigid_transform(pose: ros.geometry_msgs__msg__Pose) -> Array:
    """Return the transform (4, 4) of a pose. Raise OmnidError unless it is finite and rigid."""
    q, position = (*_xyz(pose.orientation), pose.orientation.w), _xyz(pose.position)
    if not abs(math.hypot(*q) - 1.0) < QUATERNION_TOLERANCE or not all(map(math.isfinite, position)):
        raise OmnidError(f"pose {position} {q}: expected finite numbers and a unit quaternion; check the sender")
    return se3.transform(se3.rotation(q), position)
