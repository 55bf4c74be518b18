"""Poses, commands and maps as ROS 2 messages (topic, CDR bytes) for the bus and for logs, and their sinks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Final, TypeAlias

import cv2
import numpy as np

from calib import se3
from calib.rig import Rig
from drivers.frame import Frame
from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.core.frames import carried, in_outer_axes
from omnid.core.mapping.voxel_map import ThinnedPath
from omnid.core.nanoseconds import NS_PER_S
from omnid.core.navigation.requests import NavigationState
from omnid.messages import GridUpdate, MapUpdate, NavigationUpdate, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.tracking_state import MapState, TrackingState
from omnid.transport import codec
from omnid.transport.bus import Bus
from omnid.transport.codec import CLOCK_SCHEMA, Diagnostics, DiagnosticStatus, PoseAttachment, encoded
from omnid.transport.sensor_codec import gyro_cdr, image_cdr, wheel_cdr
from omnid.transport.status_names import NAVIGATION, ODOMETRY, PLACES, Key, Stats, entry, with_reason
from omnid.transport.topics import CLOCK, MAP_POSE, PANORAMA, SCAN

Outgoing: TypeAlias = (
    OdometryUpdate
    | VelocityCommand
    | MapUpdate
    | PlaceUpdate
    | GridUpdate
    | ObstacleScan
    | NavigationUpdate
    | Diagnostics
)


UnixTime: TypeAlias = Callable[[int], int]  # returns the Unix time of a stamp [ns]
# Topic (of PUBLISHED) and bytes of an encoded message.
OutgoingMessage: TypeAlias = tuple[str, bytes]

CLOUD_POINTS: Final = 50_000  # of a cloud at most; a larger one is thinned evenly
# Of the path that is published: most vertices, the least distance between two of them, and the time between two paths.
PATH_POSES, PATH_STEP_M, PATH_NS = 500, 0.05, 5 * NS_PER_S


class Encoder:
    """Encodes messages for ROS 2; their frame odom is the base's at the first pair, not the rig's.

    The static frames come before the first pose, and a status before a pose whose state in odom or in the map is
    another one, with the stamp of the pose. On the bus the path of the base follows each PATH_NS, for programs that
    connect later.
    """

    def __init__(self, rig: Rig, scan_range_m: float, unix_ns: UnixTime = int, run_id: str = "") -> None:
        """scan_range_m: obstacles.scan.max_range_m.

        unix_ns: returns the Unix time of a stamp of the messages; that of a log is Unix time already. run_id: identity
        of the run on the bus, for other programs' recordings; empty in an own log, which holds one run.
        """
        self._rig, self._T_base_rig, self._scan_range_m = rig, rig.T_base_rig, scan_range_m
        self.unix_ns, self.run_id = unix_ns, run_id
        self._path, self._path_ns = ThinnedPath(PATH_POSES, PATH_STEP_M), 0
        self.repeat_states()

    def repeat_states(self) -> None:
        """Encode states and static frames again with the next messages, as for a new file."""
        self._state: tuple[TrackingState, int] | None = None
        self._state_in_map: MapState | None = None

    def __call__(self, message: Outgoing) -> Iterator[OutgoingMessage]:
        """Yield the encoded messages of a message."""
        stamp_ns = self.unix_ns(message.stamp_ns)
        match message:
            case OdometryUpdate():
                yield from self._poses(message, stamp_ns)
            case VelocityCommand(_, velocity_mps, _, yaw_rate_radps):
                yield "drive", codec.twist_stamped_cdr(stamp_ns, "base_link", velocity_mps, yaw_rate_radps)
            case PlaceUpdate():
                yield from self._map_pose(message, stamp_ns)
            case ObstacleScan():
                limits_m = 0.0, self._scan_range_m
                yield SCAN, codec.scan_cdr(stamp_ns, "base_link", message.ranges_m, message.sigma_m, limits_m)
                yield "moving", codec.moving_cdr(stamp_ns, "odom", message.moving)
            case MapUpdate():
                points, step = message.points, len(message.points.xyz) // CLOUD_POINTS + 1
                xyz, confidence = se3.apply(self._T_base_rig, points.xyz[::step]), points.confidence[::step]
                yield "cloud", codec.point_cloud_cdr(stamp_ns, "odom", xyz, confidence)
            case GridUpdate():
                grid = message.grid
                yield "map", codec.grid_cdr(stamp_ns, "map", grid.cells, grid.cell_m, grid.corner)
            case Diagnostics():
                yield "status", codec.diagnostics_cdr(stamp_ns, message.statuses)
            case NavigationUpdate():
                yield "navigation", codec.diagnostics_cdr(stamp_ns, [entry(NAVIGATION, navigation_stats(message))])
                if (plan := message.plan) is not None:
                    yield "plan", codec.path_cdr(stamp_ns, plan.frame, plan.xy, plan.heading_rad)

    def _poses(self, odometry: OdometryUpdate, stamp_ns: int) -> Iterator[OutgoingMessage]:
        # 1. The static frames: base_link -> rig -> lower and upper camera; the state.
        if self._state is None:
            cameras = [("rig", name, se3.inverse(camera.T_cam_rig)) for name, camera in self._rig.sides]
            yield "/tf_static", codec.transform_cdr(stamp_ns, [("base_link", "rig", self._T_base_rig), *cameras])
        if (odometry.state, odometry.reset_counter) != self._state:
            self._state = odometry.state, odometry.reset_counter
            values = {
                Key.STATE: odometry.state,
                Key.RUN: self.run_id,
                Key.RESETS: odometry.reset_counter,
                Key.INLIERS: odometry.inliers,
                Key.TRACKED: odometry.tracks,
            }
            level = list(TrackingState).index(odometry.state)
            status = DiagnosticStatus.of(ODOMETRY, level, odometry.state, values)
            yield "status", codec.diagnostics_cdr(stamp_ns, [status])
        # 2. The pose and its transform.
        T_odom_base, covariance, velocity, velocity_covariance = odometry.of_base(self._T_base_rig)
        covariance = in_outer_axes(T_odom_base, covariance)
        yield "odom", codec.odometry_cdr(stamp_ns, T_odom_base, covariance, velocity, velocity_covariance)
        yield "pose", codec.encoded(codec.POSE_SCHEMA, (stamp_ns, "odom"), T_odom_base)
        yield "/tf", codec.transform_cdr(stamp_ns, [("odom", "base_link", T_odom_base)])
        # 3. Samples of wheels and gyro up to the pair; those after it come with the next one again.
        for sample in odometry.depth.panoramas.motion:
            if sample.stamp_ns > odometry.stamp_ns:
                continue
            if isinstance(sample, WheelSample):
                yield "wheel_odom", wheel_cdr(sample, self.unix_ns(sample.stamp_ns))
            else:
                yield "imu", gyro_cdr(sample, self.unix_ns(sample.stamp_ns))
        # 4. On the bus, the path of the base.
        if self.run_id:
            self._path.add(*T_odom_base[:2, 3].tolist())
            if odometry.stamp_ns >= self._path_ns + PATH_NS:
                self._path_ns = odometry.stamp_ns
                yield "path", codec.path_cdr(stamp_ns, "odom", self._path.xy())

    def _map_pose(self, update: PlaceUpdate, stamp_ns: int) -> Iterator[OutgoingMessage]:
        if update.state != self._state_in_map:
            self._state_in_map = update.state
            yield "status", codec.diagnostics_cdr(stamp_ns, [entry(PLACES, {Key.STATE: update.state})])
        T_map_base, covariance = carried(update.T_map_rig, update.covariance, self._T_base_rig)
        pose = (T_map_base, np.ravel(in_outer_axes(T_map_base, covariance)))
        yield MAP_POSE, codec.encoded(codec.MAP_POSE_SCHEMA, (stamp_ns, "map"), pose)
        if update.is_known:  # A transform has no covariance to state that it is unknown.
            T_map_odom, _ = carried(update.T_map_odom, update.covariance, self._T_base_rig)
            yield "/tf", codec.transform_cdr(stamp_ns, [("map", "odom", T_map_odom)])


def pose_attachment(odometry: OdometryUpdate, sent_ns: int = 0, run: str = "") -> bytes:
    """Return what is attached to a pose; sent_ns: Unix time at which it is handed to the network; run: identity."""
    counts = odometry.reset_counter, odometry.inliers, odometry.tracks
    return PoseAttachment(odometry.seq, odometry.state, *counts, sent_ns, run).to_bytes()


SEVERITIES: Final = {
    NavigationState.FAILED: "_error",
    **dict.fromkeys((NavigationState.BLOCKED, NavigationState.NOT_LOCALISED, NavigationState.PAUSED), "_warning"),
}


def navigation_stats(update: NavigationUpdate) -> Stats:
    """Return the numbers of an update, for its own topic: see NavigationReport."""
    names = ("state", "task", "reason", "left_m", "offset_m")
    stats: dict[str, object] = {name: getattr(update, name) for name in names}
    stats |= {
        "command_ns": update.command_ns or "",
        "loops_left": update.loops_left if update.loops_left > 1 else "",
        SEVERITIES.get(update.state, "_ok"): with_reason(update.state, update.reason),
    }
    if update.teaching:
        stats |= {"teaching": update.teaching, "taught_m": update.taught_m}
    if update.answer is not None:
        stats |= {"request": update.answer.request, "refusal": update.answer.refusal}
    return stats


class BusSink:
    """Publishes encoded messages; live, its inbox drops the oldest, because the bus may be slow."""

    def __init__(self, bus: Bus, encode: Encoder, *, gives_time: bool = False) -> None:
        """gives_time: /clock advances by the stamps of poses and commands, which come from one thread."""
        self._bus, self._encode, self._gives_time, self._time_ns = bus, encode, gives_time, 0

    def process(self, message: Outgoing) -> None:
        """Publish a message; a pose with its attachment."""
        # 1. The clock, before what is stamped by it.
        is_moment = self._gives_time and isinstance(message, OdometryUpdate | VelocityCommand)
        if is_moment and message.stamp_ns > self._time_ns:
            self._time_ns = message.stamp_ns
            self._bus.publish(CLOCK, encoded(CLOCK_SCHEMA, self._encode.unix_ns(message.stamp_ns)))
        # 2. The message itself.
        run = self._encode.run_id
        attachment = pose_attachment(message, time.time_ns(), run) if isinstance(message, OdometryUpdate) else None
        for topic, payload in self._encode(message):
            self._bus.publish(topic, payload, attachment if topic == "odom" else None)


class PanoramaSink:
    """Publishes the panorama of the lower camera as JPEG, at most rate_hz times a second, while it has a subscriber."""

    def __init__(self, bus: Bus, rate_hz: float, unix_ns: UnixTime = int) -> None:
        """unix_ns: the Encoder's."""
        self._bus, self._period_ns, self._unix_ns = bus, NS_PER_S / rate_hz, unix_ns
        self._next_ns = 0.0

    def process(self, odometry: OdometryUpdate) -> None:
        """Publish the panorama of a pose when it is due."""
        if odometry.stamp_ns < self._next_ns or not self._bus.is_received(PANORAMA):
            return
        self._next_ns = odometry.stamp_ns + self._period_ns
        _, jpeg = cv2.imencode(".jpg", odometry.depth.panoramas.lower.panorama)
        frame = Frame(odometry.seq, odometry.stamp_ns, "lower", "jpeg", jpeg)
        self._bus.publish(PANORAMA, image_cdr(frame, self._unix_ns(odometry.stamp_ns))[1])
