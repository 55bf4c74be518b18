"""Publication of poses, commands, maps and panoramas on the bus, as `<robot>/odom` and so on."""

from __future__ import annotations

import time

import cv2

from calib import se3
from drivers.frame import Frame
from drivers.motor import VelocityCommand
from omnid.core.mapping.voxel_map import ThinnedPath
from omnid.core.nanoseconds import NS_PER_S
from omnid.messages import OdometryUpdate
from omnid.sinks.encoder import Encoder, Outgoing, UnixTime, pose_attachment
from omnid.transport.bus import Bus
from omnid.transport.codec import CLOCK_SCHEMA, encoded, path_cdr
from omnid.transport.sensor_codec import image_cdr
from omnid.transport.status_names import RUN_ID
from omnid.transport.topics import CLOCK, PANORAMA

# Of the path that is published: most vertices, the least distance between two of them, and the time between two paths.
PATH_POSES, PATH_STEP_M, PATH_NS = 500, 0.05, 5 * NS_PER_S


class BusSink:
    """Publishes encoded messages; live, its inbox drops the oldest, because the bus may be slow."""

    def __init__(self, bus: Bus, encode: Encoder, clock: type[OdometryUpdate | VelocityCommand] | None = None) -> None:
        """clock: the kind of message, from one thread, by whose stamps /clock advances, where the bus has it."""
        self._clock, self._time_ns = clock, 0
        self._path, self._path_ns = ThinnedPath(PATH_POSES, PATH_STEP_M), 0
        self._bus, self._encode, encode.run_id = bus, encode, RUN_ID

    def process(self, message: Outgoing) -> None:
        """Publish a message; a pose with its attachment."""
        # 1. The clock, before what is stamped by it.
        if self._clock is not None and isinstance(message, self._clock) and message.stamp_ns > self._time_ns:
            self._time_ns = message.stamp_ns
            self._bus.publish(CLOCK, encoded(CLOCK_SCHEMA, self._encode.unix_ns(message.stamp_ns)))
        # 2. The message itself.
        attachment = pose_attachment(message, time.time_ns(), RUN_ID) if isinstance(message, OdometryUpdate) else None
        for topic, _, payload in self._encode(message):
            self._bus.publish(topic, payload, attachment if topic == "odom" else None)
        # 3. The path of the base, from time to time, for those who come after a drive.
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
