"""Encoding of poses, commands and maps as ROS 2 messages (topic, schema, CDR bytes), for the bus and for logs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.config import Config
from omnid.core.mapping.occupancy_grid import Grid, occupancy
from omnid.core.mapping.voxel_map import MapPoints
from omnid.messages import GridUpdate, MapUpdate, NavigationUpdate, ObstacleRing, OdometryUpdate, PlaceUpdate
from omnid.sinks.navigation_status import navigation_status
from omnid.stages.geometry import GeometryVersions
from omnid.stages.odometry import base_pose, of_base
from omnid.tracking_state import MapState, TrackingState
from omnid.transport import codec, navigation_codec
from omnid.transport.motion_codec import IMU_SCHEMA, WHEEL_SCHEMA, gyro_cdr, wheel_cdr
from omnid.transport.moving_codec import moving_cdr
from omnid.transport.scan_codec import SCAN_SCHEMA, scan_cdr
from omnid.transport.status_names import ODOMETRY, PLACES, Key

Outgoing: TypeAlias = (OdometryUpdate | VelocityCommand | MapUpdate | PlaceUpdate | GridUpdate | ObstacleRing
                       | NavigationUpdate)


class OutgoingMessage(NamedTuple):
    """An encoded message; a topic without a leading '/' is below the robot's name."""

    topic: str
    schema: str
    payload: bytes


class MapEncoding(NamedTuple):
    """Encoding of the map and of the scan."""

    points: int  # largest number of points of the cloud: the most confident ones
    heights_m: tuple[float, float] = (-1.0, 1.5)  # of obstacles, in the base's frame at the start
    cell_m: float = 0.05  # of the grid
    max_range_m: float = 6.0  # of the scan
    has_places: bool = False  # the grid comes from their keyframes, in the frame map, not from the points in odom


def map_encoding(config: Config, points: int) -> MapEncoding:
    """Return the encoding of the configuration, with at most so many points."""
    return MapEncoding(points, config.mapping.heights_m, config.mapping.voxel_m, config.obstacles.ring.max_range_m,
                       config.places.enabled)


class Encoder:
    """Encodes messages for ROS 2; the odom of the encoded ones is the base's frame at the first pair, not the rig's."""

    def __init__(self, T_base_rig: NDArray[np.float64], map_encoding: MapEncoding, offset_ns: int = 0,
                 versions: GeometryVersions | None = None) -> None:
        """offset_ns: from the stamps of the messages to Unix time; 0 for a log, whose stamps are Unix time.

        versions: with the mounting of the cameras, for the static frames; None: they are left out.
        """
        self.T_base_rig, self._map_encoding, self.offset_ns = T_base_rig, map_encoding, offset_ns
        self.versions = versions

    def __call__(self, message: Outgoing) -> Iterator[OutgoingMessage]:
        """Yield the encoded messages of a message."""
        match message:
            case OdometryUpdate():
                yield from self._poses(message)
            case VelocityCommand(stamp_ns, velocity_mps, _, yaw_rate_radps):
                payload = codec.twist_stamped_cdr(stamp_ns + self.offset_ns, "base_link", velocity_mps, yaw_rate_radps)
                yield OutgoingMessage("drive", codec.TWIST_SCHEMA, payload)
            case PlaceUpdate():
                yield from self._map_pose(message)
            case ObstacleRing():
                payload = scan_cdr(message.stamp_ns + self.offset_ns, "base_link", message.ranges_m, message.sigma_m,
                                   (0.0, self._map_encoding.max_range_m))
                yield OutgoingMessage("scan", SCAN_SCHEMA, payload)
                payload = moving_cdr(message.stamp_ns + self.offset_ns, "odom", message.moving)
                yield OutgoingMessage("moving", codec.POINT_CLOUD_SCHEMA, payload)
            case MapUpdate():
                yield from self._map(message)
            case GridUpdate():
                yield self._grid("map", message.stamp_ns, message.grid)
            case NavigationUpdate():
                yield from self._navigation(message)

    def _poses(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        stamp_ns = odometry.stamp_ns + self.offset_ns
        T_odom_base, covariance, *velocity = of_base(odometry, self.T_base_rig)
        pose = codec.odometry_cdr(stamp_ns, T_odom_base, covariance, velocity[0], velocity[1])
        yield OutgoingMessage("odom", codec.ODOMETRY_SCHEMA, pose)
        yield OutgoingMessage("pose", codec.POSE_SCHEMA, codec.pose_stamped_cdr(stamp_ns, T_odom_base))
        edge = codec.FrameTransform("odom", "base_link", T_odom_base)
        yield OutgoingMessage("/tf", codec.TRANSFORM_SCHEMA, codec.transform_cdr(stamp_ns, [edge]))
        yield from self._motion(odometry)

    def _motion(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        """Yield the samples of wheels and gyro up to the pair; those after it come with the next one again."""
        for sample in odometry.motion:
            if sample.stamp_ns > odometry.stamp_ns:
                continue
            stamp_ns = sample.stamp_ns + self.offset_ns
            if isinstance(sample, WheelSample):
                yield OutgoingMessage("wheel_odom", WHEEL_SCHEMA, wheel_cdr(sample, stamp_ns))
            else:
                yield OutgoingMessage("imu", IMU_SCHEMA, gyro_cdr(sample, stamp_ns))

    def _map_pose(self, update: PlaceUpdate) -> Iterator[OutgoingMessage]:
        stamp_ns = update.stamp_ns + self.offset_ns
        T_map_base, covariance = base_pose(update.T_map_rig, update.covariance, self.T_base_rig)
        T_map_odom, _ = base_pose(update.T_map_odom, update.covariance, self.T_base_rig)
        pose = codec.pose_with_covariance_cdr(stamp_ns, T_map_base, covariance)
        yield OutgoingMessage("map_pose", codec.MAP_POSE_SCHEMA, pose)
        edge = codec.FrameTransform("map", "odom", T_map_odom)
        yield OutgoingMessage("/tf", codec.TRANSFORM_SCHEMA, codec.transform_cdr(stamp_ns, [edge]))

    def _map(self, update: MapUpdate) -> Iterator[OutgoingMessage]:
        stamp_ns = update.stamp_ns + self.offset_ns
        points = _most_confident(update.points, self._map_encoding.points)
        payload = codec.point_cloud_cdr(stamp_ns, "odom", *points, T_frame_points=self.T_base_rig)
        yield OutgoingMessage("cloud", codec.POINT_CLOUD_SCHEMA, payload)
        if self._map_encoding.has_places:
            return
        path_xy = self._in_base(_on_ground(update.path_xy))[:, :2]
        grid = occupancy(self._in_base(update.points.xyz), update.points.confidence, path_xy,
                         self._map_encoding.heights_m, self._map_encoding.cell_m)
        yield self._grid("odom", update.stamp_ns, grid)

    def _grid(self, frame: str, stamp_ns: int, grid: Grid) -> OutgoingMessage:
        payload = codec.grid_cdr(stamp_ns + self.offset_ns, frame, grid.cells, grid.cell_m, grid.corner)
        return OutgoingMessage("map", codec.GRID_SCHEMA, payload)

    def _navigation(self, update: NavigationUpdate) -> Iterator[OutgoingMessage]:
        stamp_ns = update.stamp_ns + self.offset_ns
        status = navigation_status(update)
        yield OutgoingMessage("navigation", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns, [status]))
        if update.plan is not None:
            plan = update.plan
            payload = navigation_codec.path_cdr(stamp_ns, plan.frame, plan.xy, plan.heading_rad)
            yield OutgoingMessage("plan", navigation_codec.PATH_SCHEMA, payload)

    def _in_base(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return points (N, 3) of the rig's first frame in the base's; float32 is enough for a grid of large cells."""
        T = self.T_base_rig.astype(np.float32)
        if np.array_equal(T, np.eye(4)):
            return points.astype(np.float32, copy=False)
        return np.asarray(points.astype(np.float32, copy=False) @ T[:3, :3].T + T[:3, 3])


class StateReports:
    """Yields a status whenever the state of the odometry, or of the pose in the map, changes; offset_ns: the Encoder's.
    """

    def __init__(self, offset_ns: int = 0) -> None:
        self._offset_ns = offset_ns
        self._last: tuple[str, int] | None = None
        self._last_in_map: MapState | None = None

    def __call__(self, message: OdometryUpdate | PlaceUpdate) -> Iterator[OutgoingMessage]:
        """Yield the status of a pose if its state differs from the last one."""
        yield from self._of_odometry(message) if isinstance(message, OdometryUpdate) else self._in_map(message)

    def _in_map(self, update: PlaceUpdate) -> Iterator[OutgoingMessage]:
        if update.state != self._last_in_map:
            self._last_in_map = update.state
            status = codec.DiagnosticStatus(PLACES, codec.ERROR if update.state is MapState.LOST else codec.OK,
                                            update.state, {Key.STATE: update.state})
            yield status_report(update.stamp_ns + self._offset_ns, [status])

    def _of_odometry(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        now = (odometry.state, odometry.reset_counter)
        if now != self._last:
            self._last = now
            level = list(TrackingState).index(odometry.state)
            values: dict[str, str] = {Key.STATE: odometry.state, Key.RESETS: str(odometry.reset_counter),
                                      Key.INLIERS: str(odometry.inliers), Key.TRACKED: str(odometry.tracks)}
            status = codec.DiagnosticStatus(ODOMETRY, level, odometry.state, values)
            yield status_report(odometry.stamp_ns + self._offset_ns, [status])


def status_report(stamp_ns: int, statuses: Sequence[codec.DiagnosticStatus]) -> OutgoingMessage:
    """Return statuses as one encoded message."""
    return OutgoingMessage("status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns, statuses))


def _on_ground(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (N, 2) as points (N, 3) with z = 0."""
    return np.column_stack([xy, np.zeros(len(xy))])


def _most_confident(points: MapPoints, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return positions and confidence of the most confident points, in the order of the map."""
    if len(points.xyz) <= count:
        return points.xyz, points.confidence
    kept = np.sort(np.argsort(-points.confidence, kind="stable")[:count])
    return points.xyz[kept], points.confidence[kept]
