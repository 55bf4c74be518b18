"""What is sent: ROS 2 (Humble) messages as CDR bytes, by rosbags; the same for recordings and the bus.

Arrays in SI units; p_a = T_a_b @ p_b; covariances in the order x y z rx ry rz, row-major (nav_msgs/msg/Odometry).
Attachments of zenoh are JSON with what a ROS 2 message has no field for. omnid.transport.decode reads all of this.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calib import se3
from omnid.errors import OmnidError
from omnid.transport import ros_types as ros

if TYPE_CHECKING:
    from omnid.core.obstacles.moving_tracker import MovingObstacle

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Frames = tuple[str, str]
ODOMETRY_SCHEMA = "nav_msgs/msg/Odometry"
IMU_SCHEMA = "sensor_msgs/msg/Imu"
JOINT_SCHEMA = "sensor_msgs/msg/JointState"
POSE_SCHEMA = "geometry_msgs/msg/PoseStamped"
MAP_POSE_SCHEMA = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM_SCHEMA = "tf2_msgs/msg/TFMessage"
POINT_CLOUD_SCHEMA = "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS_SCHEMA = "diagnostic_msgs/msg/DiagnosticArray"
TWIST_SCHEMA = "geometry_msgs/msg/TwistStamped"
VECTOR_SCHEMA = "geometry_msgs/msg/Vector3Stamped"
GRID_SCHEMA = "nav_msgs/msg/OccupancyGrid"
HEADER_SCHEMA = "std_msgs/msg/Header"
CLOCK_SCHEMA = "rosgraph_msgs/msg/Clock"
BOOL_SCHEMA = "std_msgs/msg/Bool"
PATH_SCHEMA = "nav_msgs/msg/Path"
STRING_SCHEMA = "std_msgs/msg/String"
SCAN_SCHEMA = "sensor_msgs/msg/LaserScan"
NS_PER_S = 1_000_000_000
MAX_SECONDS = 2**31 - 1  # builtin_interfaces/msg/Time counts seconds in an int32
OK, WARN, ERROR, STALE = range(4)  # levels of diagnostic_msgs/msg/DiagnosticStatus
CLOUD_FIELDS = ("x", "y", "z", "confidence")
CLOUD_BLOCK = 4096  # points transformed at once: temporary arrays of a whole map would fragment the memory
# m, m/s; sigma and sigma_v: of position and velocity along the axis in which they are largest.
MOVING_FIELDS: Final = ("x", "y", "z", "vx", "vy", "radius", "sigma", "sigma_v")
FEATURE_KINDS: Final = ("inliers", "rejected", "new")
MOST_FEATURES: Final = 2000  # features of a kind
_MAX_ATTACHMENT_BYTES: Final = 4096


class RosMessage(Protocol):
    """A message in the type of rosbags."""

    __msgtype__: ClassVar[str]  # such as "nav_msgs/msg/Odometry"


M = TypeVar("M", bound=RosMessage)


@dataclass(frozen=True, slots=True)
class FrameTransform:
    """One edge of the frame tree: p_parent = T_parent_child @ p_child."""

    parent: str
    child: str
    T_parent_child: Array  # (4, 4)


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


class PlanarGoal(NamedTuple):
    """Content of a PoseStamped on the floor."""

    stamp_ns: int
    frame: str
    x_m: float
    y_m: float
    heading_rad: float | None  # None: the quaternion is all zeros, which asks for no heading


@dataclass(frozen=True, slots=True)
class PoseAttachment:
    """The zenoh attachment of a pose: sequence number, tracking state and landmark counts."""

    seq: int = -1
    state: str = "unknown"  # tracking | degraded | lost
    resets: int = 0  # how often odom was started again with an unknown gap
    inliers: int = 0  # landmarks that agree with the pose
    tracked: int = 0  # landmarks found in the images
    sent_ns: int = 0  # Unix time at which it was handed to the network

    def to_bytes(self) -> bytes:
        """Encode as JSON."""
        return json.dumps(asdict(self), separators=(",", ":")).encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Decode; missing entries keep their defaults. Raise OmnidError for anything but a JSON object."""
        try:
            found = json.loads(data) if len(data) <= _MAX_ATTACHMENT_BYTES else None
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, dict):
            raise OmnidError(
                f"the {len(data)} bytes attached to a pose are not a JSON object; check that omnid sent them"
            )
        defaults = asdict(cls())
        known = {name: found[name] for name, default in defaults.items() if type(found.get(name)) is type(default)}
        return cls(**known)


@cache
def _typestore() -> Typestore:
    """Return the message definitions; made at first use, because their serialisers are compiled then."""
    return get_typestore(Stores.ROS2_HUMBLE)


def compile_serialisers(schemas: Iterable[str]) -> None:
    """Compile serialisers now: compilation at first use would delay all threads, that of the motor included."""
    for schema in schemas:
        _typestore().get_msgdef(schema)


def message_cdr(message: RosMessage) -> bytes:
    """Encode a message in the type of rosbags."""
    return bytes(_typestore().serialize_cdr(message, message.__msgtype__))


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
    return message_cdr(message)


def pose_stamped_cdr(stamp_ns: int, T_odom_body: Array) -> bytes:
    """Encode a geometry_msgs/msg/PoseStamped: the pose of a body in odom."""
    message = ros.geometry_msgs__msg__PoseStamped(header_message(stamp_ns, "odom"), pose_message(T_odom_body))
    return message_cdr(message)


def pose_with_covariance_cdr(stamp_ns: int, T_map_body: Array, covariance: Array) -> bytes:
    """Encode a geometry_msgs/msg/PoseWithCovarianceStamped: the pose of a body in the map, covariance in its axes."""
    pose = ros.geometry_msgs__msg__PoseWithCovariance(pose_message(T_map_body), _covariance(covariance))
    message = ros.geometry_msgs__msg__PoseWithCovarianceStamped(header_message(stamp_ns, "map"), pose)
    return message_cdr(message)


def transform_cdr(stamp_ns: int, transforms: Sequence[FrameTransform]) -> bytes:
    """Encode a tf2_msgs/msg/TFMessage: edges of the frame tree, all of one instant."""
    edges = [_edge(stamp_ns, edge) for edge in transforms]
    return message_cdr(ros.tf2_msgs__msg__TFMessage(edges))


def _edge(stamp_ns: int, edge: FrameTransform) -> ros.geometry_msgs__msg__TransformStamped:
    T = edge.T_parent_child
    motion = ros.geometry_msgs__msg__Transform(_vector(T[:3, 3]), _quaternion(T[:3, :3]))
    return ros.geometry_msgs__msg__TransformStamped(header_message(stamp_ns, edge.parent), edge.child, motion)


def diagnostics_cdr(stamp_ns: int, statuses: Sequence[DiagnosticStatus]) -> bytes:
    """Encode a diagnostic_msgs/msg/DiagnosticArray."""
    entries = [_status(status) for status in statuses]
    return message_cdr(ros.diagnostic_msgs__msg__DiagnosticArray(header_message(stamp_ns, ""), entries))


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
    return message_cdr(ros.geometry_msgs__msg__TwistStamped(header_message(stamp_ns, frame), twist))


def heading_cdr(stamp_ns: int, velocity_mps: float, heading_rad: float) -> bytes:
    """Encode a heading command, a geometry_msgs/msg/Vector3Stamped in odom: x is the speed, z the heading."""
    vector = _vector((velocity_mps, 0, heading_rad))
    return message_cdr(ros.geometry_msgs__msg__Vector3Stamped(header_message(stamp_ns, "odom"), vector))


def clock_cdr(stamp_ns: int) -> bytes:
    """Encode the time of a run, for programs that follow it."""
    return message_cdr(ros.rosgraph_msgs__msg__Clock(time_message(stamp_ns)))


def header_cdr(stamp_ns: int) -> bytes:
    """Encode a std_msgs/msg/Header, which is the message of cmd/arm."""
    return message_cdr(header_message(stamp_ns, ""))


def bool_cdr(value: bool) -> bytes:
    """Encode a std_msgs/msg/Bool, which is the message of cmd/bumper and cmd/cliff."""
    return message_cdr(ros.std_msgs__msg__Bool(value))


def message_from_cdr(payload: bytes, kind: type[M]) -> M:
    """Decode a message into a type of rosbags. Raise OmnidError for any other bytes."""
    schema = kind.__msgtype__
    try:
        message = _typestore().deserialize_cdr(bytes(payload), schema)
    except SerdeError as error:
        raise OmnidError(f"{len(payload)} bytes are not a {schema} in CDR ({error}); check the sender") from error
    assert isinstance(message, kind)
    return message


def point_cloud_cdr(
    stamp_ns: int,
    frame: str,
    points: ArrayLike,
    confidence: ArrayLike,
    *,
    T_frame_points: NDArray[np.float64] | None = None,
) -> bytes:
    """Encode a sensor_msgs/msg/PointCloud2 of points (N, 3) [m] with confidence (N,): float32, 16 bytes per point.

    T_frame_points (4, 4) maps the points into `frame`; None where they are given in it.
    """
    return packed_cloud_cdr(stamp_ns, frame, CLOUD_FIELDS, _packed(points, confidence, T_frame_points))


def packed_cloud_cdr(stamp_ns: int, frame: str, names: Sequence[str], rows: NDArray[np.float32]) -> bytes:
    """Encode a sensor_msgs/msg/PointCloud2 of rows (N, F), little-endian float32, whose F fields have these names."""
    number = ros.sensor_msgs__msg__PointField.FLOAT32
    message = ros.sensor_msgs__msg__PointCloud2(
        header=header_message(stamp_ns, frame),
        height=1,
        width=len(rows),
        fields=[ros.sensor_msgs__msg__PointField(name, 4 * i, number, 1) for i, name in enumerate(names)],
        is_bigendian=False,
        point_step=4 * len(names),
        row_step=4 * len(names) * len(rows),
        data=rows.reshape(-1).view(np.uint8),
        is_dense=bool(np.isfinite(rows).all()),
    )
    return message_cdr(message)


def _packed(points: ArrayLike, confidence: ArrayLike, T: NDArray[np.float64] | None) -> NDArray[np.float32]:
    """Return points, transformed in double precision, and confidence as (N, 4) little-endian float32."""
    points, confidence = np.asarray(points).reshape(-1, 3), np.asarray(confidence).reshape(-1)
    if len(points) != len(confidence):
        raise OmnidError(f"{len(confidence)} confidences for {len(points)} points: expected one for each point")
    packed = np.empty((len(points), 4), "<f4")
    packed[:, 3] = confidence
    for start in range(0, len(points), CLOUD_BLOCK):
        at = slice(start, start + CLOUD_BLOCK)
        packed[at, :3] = points[at] if T is None else se3.apply(T, points[at])
    return packed


def grid_cdr(stamp_ns: int, frame: str, cells: NDArray[np.int8], cell_m: float, corner: tuple[float, float]) -> bytes:
    """Encode a nav_msgs/msg/OccupancyGrid of cells (H, W), z = 0 in `frame`; corner: x, y of cell (0, 0), m."""
    height, width = cells.shape
    corner_pose = pose_message(se3.transform(np.eye(3), (*corner, 0.0)))
    info = ros.nav_msgs__msg__MapMetaData(time_message(stamp_ns), cell_m, width, height, corner_pose)
    message = ros.nav_msgs__msg__OccupancyGrid(header_message(stamp_ns, frame), info, cells.reshape(-1))
    return message_cdr(message)


def moving_cdr(stamp_ns: int, frame: str, moving: Sequence[MovingObstacle]) -> bytes:
    """Encode moving obstacles in a frame as a PointCloud2, a point each, none included.

    Raise OmnidError where the stamp does not fit a ROS time.
    """
    rows = [[one.x_m, one.y_m, 0.0, one.vx_mps, one.vy_mps, one.radius_m, *_sigmas(one)] for one in moving]
    return packed_cloud_cdr(stamp_ns, frame, MOVING_FIELDS, np.array(rows, "<f4").reshape(-1, len(MOVING_FIELDS)))


def _sigmas(one: MovingObstacle) -> tuple[float, float]:
    position, velocity = (one.covariance[at, at] for at in (slice(0, 2), slice(2, 4)))
    largest = [float(np.sqrt(max(0.0, np.linalg.eigvalsh(part)[-1]))) for part in (position, velocity)]
    return largest[0], largest[1]


def goal_cdr(goal: PlanarGoal) -> bytes:
    """Encode a goal as a PoseStamped."""
    pose = _planar_pose(goal.x_m, goal.y_m, goal.heading_rad)
    return message_cdr(ros.geometry_msgs__msg__PoseStamped(header_message(goal.stamp_ns, goal.frame), pose))


def path_cdr(stamp_ns: int, frame: str, xy: ArrayLike, heading_rad: float | None = None) -> bytes:
    """Encode a path through positions (N, 2); its poses point along it, the last one to the given heading."""
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    steps = np.diff(points, axis=0, append=points[-1:])
    headings: list[float | None] = [float(math.atan2(dy, dx)) for dx, dy in steps]
    headings[-1:] = [heading_rad]
    header = header_message(stamp_ns, frame)
    poses = [
        ros.geometry_msgs__msg__PoseStamped(header, _planar_pose(float(x), float(y), heading))
        for (x, y), heading in zip(points, headings, strict=True)
    ]
    return message_cdr(ros.nav_msgs__msg__Path(header, poses))


def string_cdr(text: str) -> bytes:
    """Encode a std_msgs/msg/String."""
    return message_cdr(ros.std_msgs__msg__String(text))


def _planar_pose(x_m: float, y_m: float, heading_rad: float | None) -> ros.geometry_msgs__msg__Pose:
    half_rad = 0.0 if heading_rad is None else 0.5 * heading_rad
    w = 0.0 if heading_rad is None else math.cos(half_rad)
    quaternion = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, math.sin(half_rad), w)
    return ros.geometry_msgs__msg__Pose(ros.geometry_msgs__msg__Point(x_m, y_m, 0.0), quaternion)


def scan_cdr(stamp_ns: int, frame: str, ranges_m: Floats, sigma_m: Floats, limits_m: tuple[float, float]) -> bytes:
    """Encode a sensor_msgs/msg/LaserScan of sectors (N,) that divide a full turn from azimuth -pi on.

    As REP 117 says: inf is free up to the longest range, NaN is unknown. sigma_m: standard deviations of the ranges,
    sent as intensities. limits_m: least and longest range. Raise OmnidError where the stamp does not fit a ROS time.
    """
    step, arrays = 2 * math.pi / len(ranges_m), [np.ascontiguousarray(one, "<f4") for one in (ranges_m, sigma_m)]
    angles = (step / 2 - math.pi, math.pi - step / 2, step)
    message = ros.sensor_msgs__msg__LaserScan(header_message(stamp_ns, frame), *angles, 0.0, 0.0, *limits_m, *arrays)
    return message_cdr(message)


def features_to_bytes(pixels: Mapping[str, Array]) -> bytes:
    """Encode the zenoh attachment of a panorama: pixels (N, 2) of its features, column and row, by kind.

    They are rounded to whole pixels; at most MOST_FEATURES of each kind.
    """
    rounded = {kind: np.rint(pixels[kind][:MOST_FEATURES]).astype(int).tolist() for kind in FEATURE_KINDS}
    return json.dumps(rounded, separators=(",", ":")).encode()
