"""What is read: messages of a robot, of its commanders and of recordings, decoded; the bytes may be anything.

Arrays in SI units, not to be written to; p_a = T_a_b @ p_b.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import ros_types as ros
from omnid.transport import status_names
from omnid.transport.codec import (
    CLOUD_FIELDS,
    FEATURE_KINDS,
    MOST_FEATURES,
    NS_PER_S,
    DiagnosticStatus,
    PlanarGoal,
    PoseAttachment,
    message_from_cdr,
)
from omnid.transport.status_names import Key
from omnid.transport.topics import MAP_POSE, SCAN

Array = NDArray[np.float64]
Frames = tuple[str, str]
_PLAIN_TWIST_BYTES = 4 + 6 * 8  # encapsulation header, two vectors
ASIDE_NAMES: Final = ("linear.y", "linear.z", "angular.x", "angular.y")
# A quaternion whose norm differs from 1 by more than this is refused: more than rounding to float32 or to six decimals
# makes, and less than a quaternion of zeros or one that was scaled.
QUATERNION_TOLERANCE = 1e-3
Cartesian: TypeAlias = (
    "ros.geometry_msgs__msg__Vector3 | ros.geometry_msgs__msg__Point | ros.geometry_msgs__msg__Quaternion"
)
MAX_PATH_POSES: Final = 10_000
_MOST_TILT: Final = 0.05  # Largest x and y of a quaternion that counts as a turn about z: a tilt of 6 degrees.
MOST_RANGES: Final = 100_000
_MAX_FEATURES_BYTES: Final = 1 << 17
_MAX_PX: Final = 1e5
ALIGNED = 0.999_999  # w of a quaternion that is taken for no rotation


class TwistRecord(NamedTuple):
    """Content of a TwistStamped, or of a Twist, which has no stamp (0) and no frame."""

    stamp_ns: int
    frame: str
    velocity_mps: float
    yaw_rate_radps: float
    aside: tuple[float, float, float, float]  # what no base with two driven sides has: see ASIDE_NAMES


class PlanarPath(NamedTuple):
    """Content of a Path on the floor."""

    stamp_ns: int
    frame: str
    xy: NDArray[np.float64]  # (N, 2) m
    heading_rad: float | None  # of the last pose; None: its quaternion is all zeros


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Content of a LaserScan."""

    stamp_ns: int
    frame: str
    azimuths_rad: NDArray[np.floating]  # (N,) counter-clockwise from x
    ranges_m: NDArray[np.floating]  # (N,) inf: free up to max_range_m, NaN: unknown
    sigma_m: NDArray[np.floating]  # (N,) NaN: unknown; empty in scans of other senders
    max_range_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseInMap:
    """Pose of the robot's base in the map, and its covariance (6, 6) in the map's axes."""

    stamp_ns: int
    T_map_base: Array  # (4, 4) m
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose and velocity of the robot's base with their covariances."""

    stamp_ns: int  # of Unix time, when the images were taken
    T_odom_base: Array  # (4, 4) m
    covariance: Array  # (6, 6) of the pose, x y z rx ry rz in odom axes, m^2 and rad^2
    velocity: Array  # (6,) m/s, rad/s in the base's axes
    velocity_covariance: Array  # (6, 6)
    attachment: PoseAttachment = field(default_factory=PoseAttachment)  # state, sequence number, landmarks
    received_ns: int = 0  # of Unix time, by the receiver's clock
    frames: Frames = ("odom", "base_link")  # parent, child

    @property
    def state(self) -> str:
        """tracking, degraded or lost; unknown where the sender is not omnid."""
        return self.attachment.state

    @property
    def x_m(self) -> float:
        """Position in odom, forward of the start."""
        return float(self.T_odom_base[0, 3])

    @property
    def y_m(self) -> float:
        """Position in odom, to the left of the start."""
        return float(self.T_odom_base[1, 3])

    @property
    def z_m(self) -> float:
        """Position in odom, above the start."""
        return float(self.T_odom_base[2, 3])

    @property
    def yaw_rad(self) -> float:
        """Heading in odom, counter-clockwise."""
        return float(se3.yaw(self.T_odom_base))


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """Status of the parts of a robot: odometry, cameras, stages, wheels."""

    stamp_ns: int
    statuses: tuple[DiagnosticStatus, ...]

    def value(self, name: str, key: str) -> str:
        """Return the value of a key of the entry with that name, such as "omnid: odometry"; "" where there is none."""
        found = (status.values[key] for status in self.statuses if status.name == name and key in status.values)
        return next(found, "")


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of the map."""

    stamp_ns: int
    frame: str
    points: NDArray[np.float32]  # (N, 3) m
    confidence: NDArray[np.float32]  # (N,)


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """Occupancy grid of the map."""

    stamp_ns: int
    frame: str
    cells: NDArray[np.int8]  # (H, W) -1 unknown, 0 free, up to 100 occupied; rows from low to high y, columns x
    cell_m: float
    corner: tuple[float, float]  # x, y of cell (0, 0), m


@dataclass(frozen=True, slots=True)
class NavigationReport:
    """State of goals, paths and routes; see omnid.navigation_state for the states."""

    stamp_ns: int
    state: str
    reason: str  # of a halt or an end
    task: str  # "goal", "path" or "route NAME"
    command_ns: int  # stamp of the goal or path that it follows from; 0 without
    left_m: float  # way to the end; NaN unknown
    request: str  # the newest one
    refusal: str  # empty where it was accepted
    teaching: str = ""  # name of the route that is recorded
    taught_m: float = 0.0


def twist_from_cdr(payload: bytes) -> TwistRecord:
    """Decode a TwistStamped, or a Twist, whose length no TwistStamped has; its numbers need not be finite.

    Raise OmnidError for any other bytes.
    """
    if len(payload) == _PLAIN_TWIST_BYTES:
        stamp_ns, frame, twist = 0, "", message_from_cdr(payload, ros.geometry_msgs__msg__Twist)
    else:
        message = message_from_cdr(payload, ros.geometry_msgs__msg__TwistStamped)
        stamp_ns, frame, twist = unchecked_stamp_ns(message.header.stamp), message.header.frame_id, message.twist
    linear, angular = twist.linear, twist.angular
    return TwistRecord(stamp_ns, frame, linear.x, angular.z, (linear.y, linear.z, angular.x, angular.y))


def heading_from_cdr(payload: bytes) -> tuple[int, str, float, float]:
    """Decode a Vector3Stamped that commands a heading: its stamp [ns], frame, speed [m/s] and heading [rad].

    Its numbers need not be finite. Raise OmnidError for any other bytes.
    """
    message = message_from_cdr(payload, ros.geometry_msgs__msg__Vector3Stamped)
    header, vector = message.header, message.vector
    return unchecked_stamp_ns(header.stamp), header.frame_id, vector.x, vector.z


def stamp_from_cdr(payload: bytes) -> int:
    """Decode the stamp of a Header, ns; it may be invalid. Raise OmnidError for any other bytes."""
    return unchecked_stamp_ns(message_from_cdr(payload, ros.std_msgs__msg__Header).stamp)


def bool_from_cdr(payload: bytes) -> bool:
    """Decode a Bool. Raise OmnidError for any other bytes."""
    return bool(message_from_cdr(payload, ros.std_msgs__msg__Bool).data)


def string_from_cdr(payload: bytes) -> str:
    """Decode a String. Raise OmnidError for any other bytes."""
    return message_from_cdr(payload, ros.std_msgs__msg__String).data


def unchecked_stamp_ns(stamp: ros.builtin_interfaces__msg__Time) -> int:
    """Return a stamp that may be invalid; callers check it."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


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


def goal_from_cdr(payload: bytes) -> PlanarGoal:
    """Decode a PoseStamped. Raise OmnidError for other bytes, numbers that are not finite, and a tilted pose."""
    message = message_from_cdr(payload, ros.geometry_msgs__msg__PoseStamped)
    x_m, y_m = _planar_position(message.pose)
    stamp_ns = unchecked_stamp_ns(message.header.stamp)
    return PlanarGoal(stamp_ns, message.header.frame_id, x_m, y_m, _planar_heading(message.pose))


def path_from_cdr(payload: bytes) -> PlanarPath:
    """Decode a path of 1 to MAX_PATH_POSES poses. Raise OmnidError as goal_from_cdr."""
    message = message_from_cdr(payload, ros.nav_msgs__msg__Path)
    if not 1 <= len(message.poses) <= MAX_PATH_POSES:
        raise OmnidError(f"a path of {len(message.poses)} poses: expected 1 to {MAX_PATH_POSES}")
    xy = np.array([_planar_position(entry.pose) for entry in message.poses])
    stamp_ns = unchecked_stamp_ns(message.header.stamp)
    return PlanarPath(stamp_ns, message.header.frame_id, xy, _planar_heading(message.poses[-1].pose))


def _planar_position(pose: ros.geometry_msgs__msg__Pose) -> tuple[float, float]:
    if not (math.isfinite(pose.position.x) and math.isfinite(pose.position.y)):
        raise OmnidError("a position is not finite; check the sender")
    return pose.position.x, pose.position.y


def _planar_heading(pose: ros.geometry_msgs__msg__Pose) -> float | None:
    q = (*_xyz(pose.orientation), pose.orientation.w)
    if not any(q):
        return None
    if not abs(math.hypot(*q) - 1.0) < QUATERNION_TOLERANCE or max(abs(q[0]), abs(q[1])) > _MOST_TILT:
        raise OmnidError(f"orientation {q}: expected a unit quaternion about z, or all zeros; check the sender")
    return float(se3.yaw(se3.transform(se3.rotation(q), (0.0, 0.0, 0.0))))


def decode_scan(payload: bytes, _: bytes = b"") -> Scan:
    """Decode a LaserScan. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, ros.sensor_msgs__msg__LaserScan)
    count = len(message.ranges)
    if count > MOST_RANGES or not (math.isfinite(message.angle_min) and math.isfinite(message.angle_increment)):
        raise OmnidError(
            f"a scan of {count} ranges from {message.angle_min} rad by {message.angle_increment} rad was "
            f"found; expected finite angles and at most {MOST_RANGES} ranges"
        )
    azimuths = message.angle_min + message.angle_increment * np.arange(count)
    stamp_ns = unchecked_stamp_ns(message.header.stamp)
    return Scan(
        stamp_ns, message.header.frame_id, azimuths, message.ranges, message.intensities, float(message.range_max)
    )


def features_from_bytes(data: bytes) -> dict[str, Array]:
    """Decode the pixels (N, 2) of features by kind. Raise OmnidError for any other bytes."""
    try:
        found = json.loads(data) if len(data) <= _MAX_FEATURES_BYTES else {}
        pixels = {kind: np.asarray(found[kind], np.float64).reshape(-1, 2)[:MOST_FEATURES] for kind in FEATURE_KINDS}
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        reason = f"the {len(data)} bytes attached to a panorama are not features; check that omnid sent them"
        raise OmnidError(reason) from None
    return {kind: points[(np.abs(points) < _MAX_PX).all(axis=1)] for kind, points in pixels.items()}


def decode_navigation(payload: bytes, _: bytes = b"") -> NavigationReport:
    """Decode the state of the navigation. Raise OmnidError for any other bytes."""
    report = decode_diagnostics(payload)

    def value(key: str) -> str:
        return report.value(status_names.NAVIGATION, key)

    left_m, taught_m = (status_names.number(value(key)) for key in (Key.LEFT_M, Key.TAUGHT_M))
    return NavigationReport(
        report.stamp_ns,
        value(Key.STATE),
        value(Key.REASON),
        value(Key.TASK),
        _whole(value(Key.COMMAND_NS)),
        math.nan if left_m is None else left_m,
        value(Key.REQUEST),
        value(Key.REFUSAL),
        value(Key.TEACHING),
        taught_m or 0.0,
    )


def _whole(text: str) -> int:
    """Return a number of at most 19 digits, 0 for any other text."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else 0


def decode_pose(payload: bytes, attachment: bytes = b"", received_ns: int | None = None) -> Pose:
    """Decode an Odometry message and its attachment. Raise OmnidError unless it has a finite, rigid pose.

    received_ns: time of arrival, of Unix time; default: now.
    """
    message = message_from_cdr(payload, ros.nav_msgs__msg__Odometry)
    twist = message.twist.twist
    return Pose(
        stamp_ns=_stamp_ns(message.header.stamp),
        T_odom_base=rigid_transform(message.pose.pose),
        covariance=message.pose.covariance.reshape(6, 6),
        velocity=np.array([*_xyz(twist.linear), *_xyz(twist.angular)]),
        velocity_covariance=message.twist.covariance.reshape(6, 6),
        attachment=PoseAttachment.from_bytes(attachment) if attachment else PoseAttachment(),
        received_ns=time.time_ns() if received_ns is None else received_ns,
        frames=(message.header.frame_id, message.child_frame_id),
    )


def decode_diagnostics(payload: bytes, _: bytes = b"") -> Diagnostics:
    """Decode a DiagnosticArray. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, ros.diagnostic_msgs__msg__DiagnosticArray)
    statuses = tuple(
        DiagnosticStatus(entry.name, int(entry.level), entry.message, {pair.key: pair.value for pair in entry.values})
        for entry in message.status
    )
    return Diagnostics(unchecked_stamp_ns(message.header.stamp), statuses)


def decode_cloud(payload: bytes, _: bytes = b"") -> Cloud:
    """Decode a PointCloud2 with omnid's fields. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, ros.sensor_msgs__msg__PointCloud2)
    step = 4 * len(CLOUD_FIELDS)
    fields = [(entry.name, entry.offset) for entry in message.fields]
    own = fields == [(name, 4 * i) for i, name in enumerate(CLOUD_FIELDS)] and not message.is_bigendian
    if not own or message.point_step != step or message.data.size % step:
        raise OmnidError(
            f"a cloud with {len(fields)} fields and {message.point_step} bytes a point was found; "
            f"expected the fields {', '.join(CLOUD_FIELDS)} in {step} bytes"
        )
    packed = message.data.view("<f4").reshape(-1, len(CLOUD_FIELDS))
    return Cloud(unchecked_stamp_ns(message.header.stamp), message.header.frame_id, packed[:, :3], packed[:, 3])


def decode_map_pose(payload: bytes, _: bytes = b"") -> PoseInMap:
    """Decode a PoseWithCovarianceStamped. Raise OmnidError unless the bytes are one with a finite, rigid pose."""
    message = message_from_cdr(payload, ros.geometry_msgs__msg__PoseWithCovarianceStamped)
    return PoseInMap(
        unchecked_stamp_ns(message.header.stamp),
        rigid_transform(message.pose.pose),
        message.pose.covariance.reshape(6, 6),
    )


def decode_map(payload: bytes, _: bytes = b"") -> Map:
    """Decode an OccupancyGrid that is parallel to its frame's axes. Raise OmnidError for any other bytes."""
    message = message_from_cdr(payload, ros.nav_msgs__msg__OccupancyGrid)
    info, at = message.info, message.info.origin
    if message.data.size != info.width * info.height or not (info.resolution > 0 and abs(at.orientation.w) > ALIGNED):
        raise OmnidError(
            f"a map with {message.data.size} cells of {info.resolution:g} m was found; expected "
            f"{info.width} x {info.height} cells of a positive size, parallel to the frame's axes"
        )
    return Map(
        unchecked_stamp_ns(message.header.stamp),
        message.header.frame_id,
        message.data.reshape(info.height, info.width),
        float(info.resolution),
        (at.position.x, at.position.y),
    )


# By topic; each takes the payload and the attachment.
DECODERS: Final[Mapping[str, Callable[..., Any]]] = {
    "odom": decode_pose,
    MAP_POSE: decode_map_pose,
    "status": decode_diagnostics,
    "cloud": decode_cloud,
    "map": decode_map,
    SCAN: decode_scan,
    "navigation": decode_navigation,
}
