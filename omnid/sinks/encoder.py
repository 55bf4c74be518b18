"""What leaves the daemon, as topic, schema and CDR bytes: the same for the log and the bus."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.motor import VelocityCommand
from omnid.config import Config
from omnid.core.mapping.occupancy_grid import occupancy
from omnid.core.mapping.voxel_map import MapPoints
from omnid.messages import MapUpdate, OdometryUpdate
from omnid.stages.odometry import of_base
from omnid.tracking_state import TrackingState
from omnid.transport import codec
from omnid.transport.status_names import ODOMETRY, Key

Outgoing: TypeAlias = OdometryUpdate | VelocityCommand | MapUpdate


class OutgoingMessage(NamedTuple):
    """A message ready to go."""

    topic: str
    schema: str
    payload: bytes


class Clouds(NamedTuple):
    """What is told of the map."""

    points: int  # most points of the cloud: the surest ones
    heights_m: tuple[float, float] = (-1.0, 1.5)  # of what stands in the way, in the base's frame at the start
    cell_m: float = 0.05  # of the grid


def clouds_of(config: Config, points: int) -> Clouds:
    """The same from the settings."""
    return Clouds(points, config.mapping.heights_m, config.mapping.voxel_m)


class Encoder:
    """Turns messages into those of ROS 2; their odom is the base's frame at the first pair, not the rig's.

    offset_ns: from the stamps of the messages to Unix time; 0 for a log, whose stamps are Unix time.
    """

    def __init__(self, T_base_rig: NDArray[np.float64], clouds: Clouds, offset_ns: int = 0) -> None:
        self._T_base_rig, self._clouds, self.offset_ns = T_base_rig, clouds, offset_ns

    def __call__(self, message: Outgoing) -> Iterator[OutgoingMessage]:
        """All that is said about a message."""
        match message:
            case OdometryUpdate():
                yield from self._poses(message)
            case VelocityCommand(stamp_ns, velocity_mps, _, yaw_rate_radps):
                payload = codec.twist_stamped_cdr(stamp_ns + self.offset_ns, "base_link", velocity_mps, yaw_rate_radps)
                yield OutgoingMessage("drive", codec.TWIST_SCHEMA, payload)
            case MapUpdate():
                yield from self._map(message)

    def _poses(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        stamp_ns = odometry.stamp_ns + self.offset_ns
        T_odom_base, covariance, *velocity = of_base(odometry, self._T_base_rig)
        pose = codec.odometry_cdr(stamp_ns, T_odom_base, covariance, velocity[0], velocity[1])
        yield OutgoingMessage("odom", codec.ODOMETRY_SCHEMA, pose)
        yield OutgoingMessage("pose", codec.POSE_SCHEMA, codec.pose_stamped_cdr(stamp_ns, T_odom_base))
        edges = [codec.FrameTransform("odom", "base_link", T_odom_base),
                 codec.FrameTransform("base_link", "rig", self._T_base_rig)]
        yield OutgoingMessage("/tf", codec.TRANSFORM_SCHEMA, codec.transform_cdr(stamp_ns, edges))

    def _map(self, update: MapUpdate) -> Iterator[OutgoingMessage]:
        stamp_ns = update.stamp_ns + self.offset_ns
        payload = codec.point_cloud_cdr(stamp_ns, "odom", *_surest(update.points, self._clouds.points),
                                        T_frame_points=self._T_base_rig)
        yield OutgoingMessage("cloud", codec.POINT_CLOUD_SCHEMA, payload)
        grid = occupancy(self._moved(update.points.xyz), update.points.confidence,
                         self._moved(_level(update.path_xy))[:, :2], self._clouds.heights_m, self._clouds.cell_m)
        yield OutgoingMessage("map", codec.GRID_SCHEMA, codec.grid_cdr(stamp_ns, "odom", grid.cells, grid.cell_m,
                                                                grid.corner))

    def _moved(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Points (N, 3) of the rig's first frame in the base's: single, for a map is large and a cell is wide."""
        T = self._T_base_rig.astype(np.float32)
        if np.array_equal(T, np.eye(4)):
            return points.astype(np.float32, copy=False)
        return np.asarray(points.astype(np.float32, copy=False) @ T[:3, :3].T + T[:3, 3])


class StateReports:
    """A diagnostic message whenever the state of the odometry changes; offset_ns: as the Encoder has it."""

    def __init__(self, offset_ns: int = 0) -> None:
        self._offset_ns = offset_ns
        self._last: tuple[str, int] | None = None

    def __call__(self, odometry: OdometryUpdate) -> Iterator[OutgoingMessage]:
        """What there is to report about a pose."""
        now = (odometry.state, odometry.reset_counter)
        if now != self._last:
            self._last = now
            level = list(TrackingState).index(odometry.state)
            values: dict[str, str] = {Key.STATE: odometry.state, Key.RESETS: str(odometry.reset_counter),
                      Key.INLIERS: str(odometry.inliers), Key.TRACKED: str(odometry.tracks)}
            said = codec.DiagnosticStatus(ODOMETRY, level, odometry.state, values)
            yield status_report(odometry.stamp_ns + self._offset_ns, [said])


def status_report(stamp_ns: int, statuses: Sequence[codec.DiagnosticStatus]) -> OutgoingMessage:
    """Statuses as one diagnostic message."""
    return OutgoingMessage("status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns, statuses))


def _level(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (N, 2) on the ground, z = 0."""
    return np.column_stack([xy, np.zeros(len(xy))])


def _surest(points: MapPoints, most: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions and confidence of the most confident points, in their own order."""
    if len(points.xyz) <= most:
        return points.xyz, points.confidence
    kept = np.sort(np.argsort(-points.confidence, kind="stable")[:most])
    return points.xyz[kept], points.confidence[kept]
