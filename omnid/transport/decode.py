"""Decoded messages of a robot, for subscribers and readers of recordings; the bytes may be anything.

Arrays in SI units, not to be written to; p_a = T_a_b @ p_b.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import codec, map_codec, status_names
from omnid.transport import ros_types as ros
from omnid.transport.codec import unchecked_stamp_ns
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import Key

ALIGNED = 0.999_999  # w of a quaternion that is taken for no rotation
Array = NDArray[np.float64]


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
    attachment: PoseAttachment  # state, sequence number, landmarks
    received_ns: int  # of Unix time, by the receiver's clock

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


def decode_pose(payload: bytes, attachment: bytes, received_ns: int | None = None) -> Pose:
    """Decode an Odometry message and its attachment. Raise OmnidError for any other bytes.

    received_ns: time of arrival, of Unix time; default: now.
    """
    received_ns = time.time_ns() if received_ns is None else received_ns
    record = codec.odometry_from_cdr(payload)
    return Pose(
        record.stamp_ns,
        record.T_odom_base,
        record.covariance,
        record.velocity,
        record.velocity_covariance,
        PoseAttachment.from_bytes(attachment) if attachment else PoseAttachment(),
        received_ns,
    )


def decode_diagnostics(payload: bytes, _: bytes = b"") -> Diagnostics:
    """Decode a DiagnosticArray. Raise OmnidError for any other bytes."""
    message = codec.message_from_cdr(payload, codec.DIAGNOSTICS_SCHEMA)
    assert isinstance(message, ros.diagnostic_msgs__msg__DiagnosticArray)
    statuses = tuple(
        DiagnosticStatus(entry.name, int(entry.level), entry.message, {pair.key: pair.value for pair in entry.values})
        for entry in message.status
    )
    return Diagnostics(unchecked_stamp_ns(message.header.stamp), statuses)


def decode_cloud(payload: bytes, _: bytes = b"") -> Cloud:
    """Decode a PointCloud2 with omnid's fields. Raise OmnidError for any other bytes."""
    message = codec.message_from_cdr(payload, codec.POINT_CLOUD_SCHEMA)
    assert isinstance(message, ros.sensor_msgs__msg__PointCloud2)
    step = 4 * len(map_codec.CLOUD_FIELDS)
    fields = [(entry.name, entry.offset) for entry in message.fields]
    own = fields == [(name, 4 * i) for i, name in enumerate(map_codec.CLOUD_FIELDS)] and not message.is_bigendian
    if not own or message.point_step != step or message.data.size % step:
        raise OmnidError(
            f"a cloud with {len(fields)} fields and {message.point_step} bytes a point was found; "
            f"expected the fields {', '.join(map_codec.CLOUD_FIELDS)} in {step} bytes"
        )
    packed = message.data.view("<f4").reshape(-1, len(map_codec.CLOUD_FIELDS))
    return Cloud(unchecked_stamp_ns(message.header.stamp), message.header.frame_id, packed[:, :3], packed[:, 3])


def decode_map_pose(payload: bytes, _: bytes = b"") -> PoseInMap:
    """Decode a PoseWithCovarianceStamped. Raise OmnidError unless the bytes are one with a finite, rigid pose."""
    message = codec.message_from_cdr(payload, codec.MAP_POSE_SCHEMA)
    assert isinstance(message, ros.geometry_msgs__msg__PoseWithCovarianceStamped)
    return PoseInMap(
        unchecked_stamp_ns(message.header.stamp),
        codec.rigid_transform(message.pose.pose),
        message.pose.covariance.reshape(6, 6),
    )


def decode_map(payload: bytes, _: bytes = b"") -> Map:
    """Decode an OccupancyGrid that is parallel to its frame's axes. Raise OmnidError for any other bytes."""
    message = codec.message_from_cdr(payload, codec.GRID_SCHEMA)
    assert isinstance(message, ros.nav_msgs__msg__OccupancyGrid)
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
