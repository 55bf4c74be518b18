"""Poses, commands and maps as ROS 2 messages (topic, schema, CDR bytes) for the bus and for logs, and their sinks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.rig import Rig
from drivers.frame import Frame
from drivers.motion import WheelSample
from drivers.motor import VelocityCommand
from omnid.core.frames import base_pose, in_outer_axes
from omnid.core.mapping.voxel_map import ThinnedPath
from omnid.core.nanoseconds import NS_PER_S
from omnid.messages import GridUpdate, MapUpdate, NavigationUpdate, ObstacleScan, OdometryUpdate, PlaceUpdate
from omnid.navigation_state import NavigationState, with_reason
from omnid.tracking_state import MapState, TrackingState
from omnid.transport import codec
from omnid.transport.bus import Bus
from omnid.transport.codec import CLOCK_SCHEMA, Diagnostics, DiagnosticStatus, PoseAttachment, encoded, path_cdr
from omnid.transport.sensor_codec import gyro_cdr, image_cdr, wheel_cdr
from omnid.transport.status_names import NAVIGATION, ODOMETRY, PLACES, RUN_ID, Key, Stats, entry
from omnid.transport.topics import CLOCK, MAP_POSE, PANORAMA, PUBLISHED, SCAN

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
# Topic, ROS type and bytes of an encoded message; a topic without a leading '/' is below the robot's name.
OutgoingMessage: TypeAlias = tuple[str, str, bytes]

# Of the path that is published: most vertices, the least distance between two of them, and the time between two paths.
PATH_POSES, PATH_STEP_M, PATH_NS = 500, 0.05, 5 * NS_PER_S


def _on(topic: str, payload: bytes) -> OutgoingMessage:
    """Return a message on one of the topics that are published."""
    return topic, PUBLISHED[topic].schema, payload


class Encoder:
    """Encodes messages for ROS 2; their frame odom is the base's at the first pair, not the rig's.

    The static frames come before the first pose, and a status before a pose whose state in odom or in the map is
    another one, with the stamp of the pose.
    """

    def __init__(
        self,
        T_base_rig: NDArray[np.float64],
        cloud_points: int,
        unix_ns: UnixTime = int,
        rig: Rig | None = None,
        scan_range_m: float = 6.0,
    ) -> None:
        """cloud_points: the largest number of points of the cloud; a larger one is thinned evenly.

        unix_ns: returns the Unix time of a stamp of the messages; that of a log is Unix time already. rig: with the
        mounting of the cameras, for the static frames; None: they are left out.
        """
        self.T_base_rig, self.unix_ns, self._rig = T_base_rig, unix_ns, rig
        self._cloud_points, self._scan_range_m = cloud_points, scan_range_m
        self.run_id = ""  # identity of the run, for other programs' recordings; an own log holds one run
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
                payload = codec.twist_stamped_cdr(stamp_ns, "base_link", velocity_mps, yaw_rate_radps)
                yield _on("drive", payload)
            case PlaceUpdate():
                yield from self._map_pose(message, stamp_ns)
            case ObstacleScan():
                limits_m = 0.0, self._scan_range_m
                yield _on(SCAN, codec.scan_cdr(stamp_ns, "base_link", message.ranges_m, message.sigma_m, limits_m))
                yield _on("moving", codec.moving_cdr(stamp_ns, "odom", message.moving))
            case MapUpdate():
                points, step = message.points, len(message.points.xyz) // self._cloud_points + 1
                xyz, confidence = se3.apply(self.T_base_rig, points.xyz[::step]), points.confidence[::step]
                yield _on("cloud", codec.point_cloud_cdr(stamp_ns, "odom", xyz, confidence))
            case GridUpdate():
                grid = message.grid
                yield _on("map", codec.grid_cdr(stamp_ns, "map", grid.cells, grid.cell_m, grid.corner))
            case Diagnostics():
                yield _on("status", codec.diagnostics_cdr(stamp_ns, message.statuses))
            case NavigationUpdate():
                status = entry(NAVIGATION, navigation_stats(message))
                yield _on("navigation", codec.diagnostics_cdr(stamp_ns, [status]))
                if message.plan is not None:
                    plan = message.plan
                    yield _on("plan", codec.path_cdr(stamp_ns, plan.frame, plan.xy, plan.heading_rad))

    def _poses(self, odometry: OdometryUpdate, stamp_ns: int) -> Iterator[OutgoingMessage]:
        # 1. The static frames: base_link -> rig -> lower and upper camera; the state.
        if self._state is None:
            edges = [("base_link", "rig", self.T_base_rig)]
            if self._rig is not None:
                cameras = {"lower": self._rig.lower, "upper": self._rig.upper}
                edges += [("rig", name, se3.inverse(camera.T_cam_rig)) for name, camera in cameras.items()]
            yield _on("/tf_static", codec.transform_cdr(stamp_ns, edges))
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
            yield _on("status", codec.diagnostics_cdr(stamp_ns, [status]))
        # 2. The pose and its transform.
        T_odom_base, covariance, velocity, velocity_covariance = odometry.of_base(self.T_base_rig)
        covariance = in_outer_axes(T_odom_base, covariance)
        yield _on("odom", codec.odometry_cdr(stamp_ns, T_odom_base, covariance, velocity, velocity_covariance))
        yield _on("pose", codec.encoded(codec.POSE_SCHEMA, (stamp_ns, "odom"), T_odom_base))
        yield _on("/tf", codec.transform_cdr(stamp_ns, [("odom", "base_link", T_odom_base)]))
        # 3. Samples of wheels and gyro up to the pair; those after it come with the next one again.
        for sample in odometry.motion:
            if sample.stamp_ns > odometry.stamp_ns:
                continue
            if isinstance(sample, WheelSample):
                yield _on("wheel_odom", wheel_cdr(sample, self.unix_ns(sample.stamp_ns)))
            else:
                yield _on("imu", gyro_cdr(sample, self.unix_ns(sample.stamp_ns)))

    def _map_pose(self, update: PlaceUpdate, stamp_ns: int) -> Iterator[OutgoingMessage]:
        if update.state != self._state_in_map:
            self._state_in_map = update.state
            status = entry(PLACES, {Key.STATE: update.state})
            yield _on("status", codec.diagnostics_cdr(stamp_ns, [status]))
        T_map_base, covariance = base_pose(update.T_map_rig, update.covariance, self.T_base_rig)
        pose = (T_map_base, np.ravel(in_outer_axes(T_map_base, covariance)))
        yield _on(MAP_POSE, codec.encoded(codec.MAP_POSE_SCHEMA, (stamp_ns, "map"), pose))
        if update.is_known:  # A transform has no covariance to state that it is unknown.
            T_map_odom, _ = base_pose(update.T_map_odom, update.covariance, self.T_base_rig)
            yield _on("/tf", codec.transform_cdr(stamp_ns, [("map", "odom", T_map_odom)]))


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
        self._gives_time, self._time_ns = gives_time, 0
        self._path, self._path_ns = ThinnedPath(PATH_POSES, PATH_STEP_M), 0
        self._bus, self._encode, encode.run_id = bus, encode, RUN_ID

    def process(self, message: Outgoing) -> None:
        """Publish a message; a pose with its attachment."""
        # 1. The clock, before what is stamped by it.
        is_moment = self._gives_time and isinstance(message, OdometryUpdate | VelocityCommand)
        if is_moment and message.stamp_ns > self._time_ns:
            self._time_ns = message.stamp_ns
            self._bus.publish(CLOCK, encoded(CLOCK_SCHEMA, self._encode.unix_ns(message.stamp_ns)))
        # 2. The message itself.
        attachment = pose_attachment(message, time.time_ns(), RUN_ID) if isinstance(message, OdometryUpdate) else None
        for topic, _, payload in self._encode(message):
            self._bus.publish(topic, payload, attachment if topic == "odom" else None)
        # 3. The path of the base each PATH_NS, for subscribers that connect later.
        if isinstance(message, OdometryUpdate):
            T_base_rig = self._encode.T_base_rig
            T_odom_base = T_base_rig @ message.T_odom_rig @ se3.inverse(T_base_rig)
            self._path.add(*T_odom_base[:2, -1].tolist())
            if message.stamp_ns >= self._path_ns + PATH_NS:
                self._path_ns = message.stamp_ns
                path = path_cdr(self._encode.unix_ns(message.stamp_ns), "odom", self._path.xy())
                self._bus.publish("path", path)


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
