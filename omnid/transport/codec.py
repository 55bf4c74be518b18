"""Messages of the bus and of recordings: types of ROS 2 (Humble) as CDR bytes, by rosbags, both ways.

A message is encoded from the values of its fields, in the order of its definition; a message among them is the tuple of
its own fields, a Time its nanoseconds, a Pose or Transform the rigid transform (4, 4). Arrays are in SI units and not
to be written to; p_a = T_a_b @ p_b; covariances are in the order x y z rx ry rz, row-major (nav_msgs/msg/Odometry).
Attachments of zenoh are JSON with what a message has no field for. Bytes that are decoded may be anything: all decoders
raise OmnidError for those that are no such message. Encoders raise it for a stamp that is no ROS time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from struct import calcsize
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self, TypeAlias

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calib import se3
from omnid.core.nanoseconds import NS_PER_S
from omnid.errors import OmnidError
from omnid.plain_text import MAX_ENTRIES, plain

if TYPE_CHECKING:
    from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Frames = tuple[str, str]
Values: TypeAlias = tuple[object, ...]  # of the fields of a message
ODOMETRY_SCHEMA = "nav_msgs/msg/Odometry"
IMU_SCHEMA = "sensor_msgs/msg/Imu"
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
PATH_SCHEMA = "nav_msgs/msg/Path"
STRING_SCHEMA = "std_msgs/msg/String"
SCAN_SCHEMA = "sensor_msgs/msg/LaserScan"
IMAGE_SCHEMA = "sensor_msgs/msg/CompressedImage"
OK, WARN, ERROR, STALE = range(4)  # levels of diagnostic_msgs/msg/DiagnosticStatus
# A quaternion whose norm differs from 1 by more than this is refused: more than rounding to float32 or to six decimals
# makes, and less than a quaternion of zeros or one that was scaled.
QUATERNION_TOLERANCE = 1e-3


# Bytes, stamps and geometry.


@cache
def _typestore() -> Typestore:
    """Return the message definitions; made at first use, because their serialisers are compiled then."""
    return get_typestore(Stores.ROS2_HUMBLE)


def compile_serialisers(schemas: Iterable[str]) -> None:
    """Compile serialisers now: compilation at first use would delay all threads, that of the motor included."""
    for schema in schemas:
        _typestore().get_msgdef(schema)


def encoded(schema: str, *values: object) -> bytes:
    """Return the CDR bytes of a message, such as encoded("std_msgs/msg/Header", 2_000_000_500, "odom")."""
    return bytes(_typestore().serialize_cdr(_message(schema, values), schema))


@cache
def _parts(schema: str) -> tuple[tuple[bool, str], ...]:
    """Return for each field of a message whether it is a list of messages, and their type; "" for another field."""
    parts = []
    kind: Any  # of a field: a type, or a sequence or an array of one type and its length
    for _, kind in _typestore().fielddefs[schema][1]:
        is_list = kind[0] in (Nodetype.SEQUENCE, Nodetype.ARRAY)
        node, content = kind[1][0] if is_list else kind
        parts.append((is_list, content if node == Nodetype.NAME else ""))
    return tuple(parts)


def _message(schema: str, value: Any) -> Any:
    """Return a message in the type of rosbags."""
    values = value if isinstance(value, tuple) else _FIELDS_OF[schema](value)
    fields: list[Any] = [
        value if not part else [_message(part, one) for one in value] if is_list else _message(part, value)
        for value, (is_list, part) in zip(values, _parts(schema), strict=True)
    ]
    return _typestore().types[schema](*fields)


def ros_time(stamp_ns: int) -> tuple[int, int]:
    """Return the fields of a Time: seconds and nanoseconds."""
    seconds, nanoseconds = divmod(int(stamp_ns), NS_PER_S)
    if not 0 <= seconds < 1 << 31:  # an int32
        raise OmnidError(f"stamp {stamp_ns} ns does not fit a ROS time (1970 to 2038); give nanoseconds of Unix time")
    return seconds, nanoseconds


def _pose_fields(T: Array) -> Values:
    """Return the fields of a Pose, and of a Transform, which has the same: position and quaternion."""
    return tuple(T[:3, 3].tolist()), tuple(se3.quaternion(T[:3, :3]).tolist())


# Fields of a message by the value that stands for it.
_FIELDS_OF: Final[Mapping[str, Callable[[Any], Values]]] = {
    "builtin_interfaces/msg/Time": ros_time,
    "geometry_msgs/msg/Pose": _pose_fields,
    "geometry_msgs/msg/Transform": _pose_fields,
}


def decoded(payload: bytes, schema: str) -> Any:
    """Return a message in the type of rosbags."""
    try:
        return _typestore().deserialize_cdr(bytes(payload), schema)
    except SerdeError as error:
        raise OmnidError(f"{len(payload)} bytes are not a {schema} in CDR ({error}); check the sender") from error


def stamp_of(header: Any) -> int:
    """Return the stamp of a header [ns]; it may be invalid, and those who rely on it check it."""
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)


def _rigid_transform(pose: Any) -> Array:
    """Return the transform (4, 4) of a Pose, which must be finite and rigid."""
    q, p = pose.orientation, pose.position
    xyzw, position = (q.x, q.y, q.z, q.w), (p.x, p.y, p.z)
    if not abs(math.hypot(*xyzw) - 1.0) < QUATERNION_TOLERANCE or not all(map(math.isfinite, position)):
        raise OmnidError(f"pose {position} {xyzw}: expected finite numbers and a unit quaternion; check the sender")
    return se3.transform(se3.rotation(xyzw), position)


# Poses.


@dataclass(frozen=True, slots=True)
class PoseAttachment:
    """The zenoh attachment of a pose: sequence number, tracking state, landmark counts and the run."""

    seq: int = -1
    state: str = "unknown"  # tracking | degraded | lost
    resets: int = 0  # how often odom was started again with an unknown gap
    inliers: int = 0  # landmarks that agree with the pose
    tracked: int = 0  # landmarks found in the images
    sent_ns: int = 0  # Unix time at which it was handed to the network
    run: str = ""  # identity of the daemon's run; another run has another odom

    def to_bytes(self) -> bytes:
        """Encode as JSON."""
        return msgspec.json.encode(self)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Decode a JSON object; missing entries keep their defaults."""
        try:
            return msgspec.json.decode(data, type=cls)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise OmnidError(f"the {len(data)} bytes attached to a pose are not its JSON ({error})") from error


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose and velocity of the robot's base with their covariances."""

    stamp_ns: int  # of Unix time, when the images were taken
    T_odom_base: Array  # (4, 4) m
    covariance: Array  # (6, 6) of the pose, x y z rx ry rz in odom axes, m^2 and rad^2
    velocity: Array  # (6,) m/s, rad/s in the base's axes
    velocity_covariance: Array  # (6, 6)
    attachment: PoseAttachment = field(default_factory=PoseAttachment)  # state, sequence number, landmarks
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


def odometry_cdr(
    stamp_ns: int, T_odom_base: Array, covariance: Array, velocity: Array, velocity_covariance: Array
) -> bytes:
    """Encode a nav_msgs/msg/Odometry: pose in odom, velocity (6,) [m/s, rad/s] in base_link."""
    linear, angular = (tuple(part.tolist()) for part in np.split(velocity, 2))
    pose, twist = (T_odom_base, np.ravel(covariance)), ((linear, angular), np.ravel(velocity_covariance))
    return encoded(ODOMETRY_SCHEMA, (stamp_ns, "odom"), "base_link", pose, twist)


def decode_pose(payload: bytes, attachment: bytes = b"") -> Pose:
    """Decode an Odometry with a finite, rigid pose and a valid stamp, and its attachment."""
    message = decoded(payload, ODOMETRY_SCHEMA)
    stamp, twist = message.header.stamp, message.twist.twist
    if stamp.sec < 0 or stamp.nanosec >= NS_PER_S:
        raise OmnidError(f"odometry stamp {stamp.sec} s {stamp.nanosec} ns: expected Unix time; check the sender")
    return Pose(
        stamp_ns=stamp_of(message.header),
        T_odom_base=_rigid_transform(message.pose.pose),
        covariance=message.pose.covariance.reshape(6, 6),
        velocity=np.array([getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]),
        velocity_covariance=message.twist.covariance.reshape(6, 6),
        attachment=PoseAttachment.from_bytes(attachment) if attachment else PoseAttachment(),
        frames=(message.header.frame_id, message.child_frame_id),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PoseInMap:
    """Pose of the robot's base in the map, and its covariance (6, 6) in the map's axes."""

    stamp_ns: int
    T_map_base: Array  # (4, 4) m
    covariance: Array


def decode_map_pose(payload: bytes, _: bytes = b"") -> PoseInMap:
    """Decode a PoseWithCovarianceStamped with a finite, rigid pose."""
    message = decoded(payload, MAP_POSE_SCHEMA)
    return PoseInMap(
        stamp_of(message.header), _rigid_transform(message.pose.pose), message.pose.covariance.reshape(6, 6)
    )


def transform_cdr(stamp_ns: int, edges: Iterable[tuple[str, str, Array]]) -> bytes:
    """Encode a tf2_msgs/msg/TFMessage: edges of the frame tree, all of one instant.

    edges: parent, child, T_parent_child (4, 4), with p_parent = T_parent_child @ p_child.
    """
    return encoded(TRANSFORM_SCHEMA, [((stamp_ns, parent), child, T) for parent, child, T in edges])


# Status.


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """Status of one part of the robot; names and keys: omnid.transport.status_names."""

    name: str
    level: int  # OK ...
    message: str
    values: Mapping[str, str]

    @classmethod
    def of(cls, name: str, level: int, message: str, values: Mapping[Any, object]) -> Self:
        """Return a status. Numbers of values are written with five digits; what is unknown ("", NaN) is left out."""
        texts = {str(key): f"{value:.5g}" if isinstance(value, float) else str(value) for key, value in values.items()}
        return cls(name, level, message, {key: text for key, text in texts.items() if text not in ("", "nan")})


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """Status of the parts of a robot: odometry, cameras, stages, wheels."""

    stamp_ns: int
    statuses: tuple[DiagnosticStatus, ...]

    def value(self, name: str, key: str) -> str:
        """Return the value of a key of the entry with that name, such as "omnid: odometry"; "" where there is none."""
        found = (status.values[key] for status in self.statuses if status.name == name and key in status.values)
        return next(found, "")


def diagnostics_cdr(stamp_ns: int, statuses: Sequence[DiagnosticStatus]) -> bytes:
    """Encode a diagnostic_msgs/msg/DiagnosticArray."""
    entries = [(status.level, status.name, status.message, "", list(status.values.items())) for status in statuses]
    return encoded(DIAGNOSTICS_SCHEMA, (stamp_ns, ""), entries)


def decode_diagnostics(payload: bytes, _: bytes = b"") -> Diagnostics:
    """Decode a DiagnosticArray; its texts, which may be anything, become printable ones of limited length."""
    message = decoded(payload, DIAGNOSTICS_SCHEMA)
    statuses = tuple(
        DiagnosticStatus(
            plain(entry.name),
            int(entry.level),
            plain(entry.message),
            {plain(pair.key): plain(pair.value) for pair in entry.values[:MAX_ENTRIES]},
        )
        for entry in message.status
    )
    return Diagnostics(stamp_of(message.header), statuses)


# Maps and obstacles.

CLOUD_FIELDS = ("x", "y", "z", "confidence")
# m, m/s; sigma and sigma_v: of position and velocity along the axis in which they are largest.
MOVING_FIELDS: Final = ("x", "y", "z", "vx", "vy", "radius", "sigma", "sigma_v")


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of the map."""

    stamp_ns: int
    frame: str
    points: Floats  # (N, 3) m
    confidence: Floats  # (N,)


def point_cloud_cdr(stamp_ns: int, frame: str, points: ArrayLike, confidence: ArrayLike) -> bytes:
    """Encode a sensor_msgs/msg/PointCloud2 of points (N, 3) [m] with confidence (N,): float32, 16 bytes per point."""
    points = np.asarray(points).reshape(-1, 3)
    rows = np.empty((len(points), 4), "<f4")
    rows[:, :3] = points
    rows[:, 3] = confidence
    return _cloud_cdr(stamp_ns, frame, CLOUD_FIELDS, rows)


def moving_cdr(stamp_ns: int, frame: str, moving: Sequence[MovingObstacle]) -> bytes:
    """Encode moving obstacles in a frame as a PointCloud2, a point each, none included."""
    rows = np.zeros((len(moving), len(MOVING_FIELDS)), "<f4")
    for row, one in zip(rows, moving, strict=True):
        variances = [np.linalg.eigvalsh(one.covariance[at, at])[-1] for at in (slice(0, 2), slice(2, 4))]
        row[:] = [one.x_m, one.y_m, 0.0, one.vx_mps, one.vy_mps, one.radius_m, *np.sqrt(np.maximum(0.0, variances))]
    return _cloud_cdr(stamp_ns, frame, MOVING_FIELDS, rows)


def _cloud_cdr(stamp_ns: int, frame: str, names: Sequence[str], rows: Floats) -> bytes:
    """Encode a PointCloud2 of rows (N, F), little-endian float32, whose F fields have these names."""
    number, step = np.dtype("<f4").itemsize, np.dtype("<f4").itemsize * len(names)
    point_field: Any = _typestore().types["sensor_msgs/msg/PointField"]
    fields = [(name, number * i, point_field.FLOAT32, 1) for i, name in enumerate(names)]
    head, data, is_dense = (stamp_ns, frame), rows.reshape(-1).view(np.uint8), bool(np.isfinite(rows).all())
    return encoded(POINT_CLOUD_SCHEMA, head, 1, len(rows), fields, False, step, step * len(rows), data, is_dense)


def decode_cloud(payload: bytes, _: bytes = b"") -> Cloud:
    """Decode a PointCloud2 with omnid's fields."""
    message = decoded(payload, POINT_CLOUD_SCHEMA)
    step = 4 * len(CLOUD_FIELDS)
    fields = [(entry.name, entry.offset) for entry in message.fields]
    own = fields == [(name, 4 * i) for i, name in enumerate(CLOUD_FIELDS)] and not message.is_bigendian
    if not own or message.point_step != step or message.data.size % step:
        raise OmnidError(f"a cloud: expected the fields {', '.join(CLOUD_FIELDS)} in {step} bytes a point")
    packed = message.data.view("<f4").reshape(-1, len(CLOUD_FIELDS))
    return Cloud(stamp_of(message.header), message.header.frame_id, packed[:, :3], packed[:, 3])


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """Occupancy grid of the map."""

    stamp_ns: int
    frame: str
    cells: NDArray[np.int8]  # (H, W) -1 unknown, 0 free, up to 100 occupied; rows from low to high y, columns x
    cell_m: float
    corner: tuple[float, float]  # x, y of cell (0, 0), m


def grid_cdr(stamp_ns: int, frame: str, cells: NDArray[np.int8], cell_m: float, corner: tuple[float, float]) -> bytes:
    """Encode a nav_msgs/msg/OccupancyGrid of cells (H, W), z = 0 in `frame`; corner: x, y of cell (0, 0), m."""
    height, width = cells.shape
    info = stamp_ns, cell_m, width, height, se3.transform(np.eye(3), (*corner, 0.0))
    return encoded(GRID_SCHEMA, (stamp_ns, frame), info, cells.reshape(-1))


def decode_map(payload: bytes, _: bytes = b"") -> Map:
    """Decode an OccupancyGrid that is parallel to its frame's axes."""
    message = decoded(payload, GRID_SCHEMA)
    info, T_frame_grid = message.info, _rigid_transform(message.info.origin)
    is_parallel = np.allclose(T_frame_grid[:3, :3], np.eye(3), atol=QUATERNION_TOLERANCE)
    if message.data.size != info.width * info.height or not (0 < info.resolution < math.inf and is_parallel):
        words = f"{info.width} x {info.height} cells of a finite, positive size, parallel to the frame's axes"
        raise OmnidError(f"a map of {message.data.size} cells of {info.resolution:g} m: expected {words}")
    cells, corner = message.data.reshape(info.height, info.width), (info.origin.position.x, info.origin.position.y)
    return Map(stamp_of(message.header), message.header.frame_id, cells, float(info.resolution), corner)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Content of a LaserScan."""

    stamp_ns: int
    frame: str
    azimuths_rad: NDArray[np.floating]  # (N,) counter-clockwise from x
    ranges_m: NDArray[np.floating]  # (N,) inf: free up to max_range_m, NaN: unknown
    sigma_m: NDArray[np.floating]  # (N,) NaN: unknown; empty in scans of other senders
    max_range_m: float


def scan_cdr(stamp_ns: int, frame: str, ranges_m: Floats, sigma_m: Floats, limits_m: tuple[float, float]) -> bytes:
    """Encode a sensor_msgs/msg/LaserScan of sectors (N,) that divide a full turn from azimuth -pi on.

    As REP 117 says: inf is free up to the longest range, NaN is unknown. sigma_m: standard deviations of the ranges,
    sent as intensities. limits_m: least and longest range.
    """
    step, arrays = 2 * math.pi / len(ranges_m), [np.ascontiguousarray(one, "<f4") for one in (ranges_m, sigma_m)]
    angles = (step / 2 - math.pi, math.pi - step / 2, step)
    return encoded(SCAN_SCHEMA, (stamp_ns, frame), *angles, 0.0, 0.0, *limits_m, *arrays)


def decode_scan(payload: bytes, _: bytes = b"") -> Scan:
    """Decode a LaserScan with finite angles."""
    message = decoded(payload, SCAN_SCHEMA)
    start_rad, step_rad = message.angle_min, message.angle_increment
    if not (math.isfinite(start_rad) and math.isfinite(step_rad)):
        raise OmnidError(f"a scan from {start_rad} rad by {step_rad} rad was found; expected finite angles")
    azimuths_rad, stamp_ns = start_rad + step_rad * np.arange(len(message.ranges)), stamp_of(message.header)
    range_max_m = float(message.range_max)
    return Scan(stamp_ns, message.header.frame_id, azimuths_rad, message.ranges, message.intensities, range_max_m)


# Commands and requests.

_PLAIN_TWIST_BYTES: Final = calcsize("<4x6d")  # encapsulation header, two vectors


class TwistRecord(NamedTuple):
    """Content of a TwistStamped, or of a Twist, which has no stamp (0) and no frame."""

    stamp_ns: int
    frame: str
    velocity_mps: float
    yaw_rate_radps: float
    unsupported: Mapping[str, float]  # what no base with two driven sides has, by name, such as "linear.y"


class PlanarPath(NamedTuple):
    """Content of a Path on the floor, or of a PoseStamped, a path to one place."""

    stamp_ns: int
    frame: str
    xy: Array  # (N, 2) m
    heading_rad: float | None  # of the last pose; None: its quaternion is all zeros, which asks for no heading


def twist_stamped_cdr(stamp_ns: int, frame: str, linear_mps: float, yaw_rate_radps: float) -> bytes:
    """Encode a geometry_msgs/msg/TwistStamped of a ground robot: forward speed and yaw rate in `frame`."""
    twist = (linear_mps, 0.0, 0.0), (0.0, 0.0, yaw_rate_radps)
    return encoded(TWIST_SCHEMA, (stamp_ns, frame), twist)


def twist_from_cdr(payload: bytes) -> TwistRecord:
    """Decode a TwistStamped, or a Twist, whose length no TwistStamped has; its numbers need not be finite."""
    if len(payload) == _PLAIN_TWIST_BYTES:
        stamp_ns, frame, twist = 0, "", decoded(payload, PLAIN_TWIST_SCHEMA)
    else:
        message = decoded(payload, TWIST_SCHEMA)
        stamp_ns, frame, twist = stamp_of(message.header), message.header.frame_id, message.twist
    linear, angular = twist.linear, twist.angular
    unsupported = {"linear.y": linear.y, "linear.z": linear.z, "angular.x": angular.x, "angular.y": angular.y}
    return TwistRecord(stamp_ns, frame, linear.x, angular.z, unsupported)


def header_cdr(stamp_ns: int) -> bytes:
    """Encode a std_msgs/msg/Header, which is the message of cmd/arm."""
    return encoded(HEADER_SCHEMA, stamp_ns, "")


def string_cdr(text: str) -> bytes:
    """Encode a std_msgs/msg/String."""
    return encoded(STRING_SCHEMA, text)


def string_from_cdr(payload: bytes) -> str:
    """Decode a String."""
    return str(decoded(payload, STRING_SCHEMA).data)


def goal_cdr(stamp_ns: int, frame: str, xy: tuple[float, float], heading_rad: float | None) -> bytes:
    """Encode a goal as a PoseStamped; heading_rad: None for any."""
    return encoded(POSE_SCHEMA, (stamp_ns, frame), _planar_pose(*xy, heading_rad))


def path_cdr(stamp_ns: int, frame: str, xy: ArrayLike, heading_rad: float | None = None) -> bytes:
    """Encode a path through positions (N, 2); its poses point along it, the last one to the given heading."""
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    steps = np.diff(points, axis=0, append=points[-1:])
    headings: list[float | None] = [float(math.atan2(dy, dx)) for dx, dy in steps]
    headings[-1:] = [heading_rad]
    head = stamp_ns, frame
    poses = [(head, _planar_pose(x, y, heading)) for (x, y), heading in zip(points.tolist(), headings, strict=True)]
    return encoded(PATH_SCHEMA, head, poses)


def path_from_cdr(payload: bytes, _: bytes = b"", *, schema: str = PATH_SCHEMA) -> PlanarPath:
    """Decode a Path, or a PoseStamped, of poses that are finite; the last one is not tilted."""
    message = decoded(payload, schema)
    poses = [message] if schema == POSE_SCHEMA else message.poses
    if not poses:
        raise OmnidError("a path without poses: expected one or more")
    # 1. The positions.
    xy = np.array([(one.pose.position.x, one.pose.position.y) for one in poses])
    if not np.isfinite(xy).all():
        raise OmnidError("a position is not finite; check the sender")
    # 2. The heading at the end, which a quaternion of zeros does not ask for.
    last, heading_rad = poses[-1].pose, None
    q = last.orientation
    if any((q.x, q.y, q.z, q.w)):
        T = _rigid_transform(last)
        if T[2, 2] < 0.5:  # tilted by 60 degrees: what was meant is not a turn about z
            raise OmnidError(f"orientation {q.x, q.y, q.z, q.w}: expected a turn about z, or all zeros")
        heading_rad = float(se3.yaw(T))
    return PlanarPath(stamp_of(message.header), message.header.frame_id, xy, heading_rad)


def _planar_pose(x_m: float, y_m: float, heading_rad: float | None) -> Values:
    turn = (0.0, 0.0) if heading_rad is None else (math.sin(heading_rad / 2), math.cos(heading_rad / 2))
    return (x_m, y_m, 0.0), (0.0, 0.0, *turn)


# Images.


@dataclass(frozen=True, slots=True, eq=False)
class Panorama:
    """Image of the lower camera as a panorama."""

    stamp_ns: int
    data: bytes  # JPEG


def decode_panorama(payload: bytes, _: bytes = b"") -> Panorama:
    """Decode a CompressedImage."""
    message = decoded(payload, IMAGE_SCHEMA)
    return Panorama(stamp_of(message.header), message.data.tobytes())
