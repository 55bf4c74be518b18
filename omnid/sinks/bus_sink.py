"""Publication of poses, commands, maps and panoramas on the bus, as `<robot>/odom` and so on."""

from __future__ import annotations

import time

import cv2

from drivers.frame import Frame
from drivers.motor import VelocityCommand
from omnid.messages import OdometryUpdate, PlaceUpdate
from omnid.sinks.encoder import Encoder, Outgoing, StateReports, UnixTime, same_time, static_frames
from omnid.transport.bus import Bus
from omnid.transport.codec import PoseAttachment, clock_cdr, features_to_bytes
from omnid.transport.sensor_codec import image_cdr
from omnid.transport.status_names import RUN_ID
from omnid.transport.topics import CLOCK, PANORAMA


class BusSink:
    """Publishes encoded messages; its inbox drops the oldest (policy NEWEST), because the bus may be slow."""

    def __init__(self, bus: Bus, encode: Encoder, clock: type[OdometryUpdate | VelocityCommand] | None = None) -> None:
        """clock: the kind of message, from one thread, by whose stamps /clock advances, where the bus has it."""
        self._clock, self._time_ns = clock, 0
        self._bus, self._encode, self._states = bus, encode, StateReports(encode.unix_ns, RUN_ID)
        self._gave_frames = False

    def process(self, message: Outgoing) -> None:
        """Publish a message; a pose with its attachment, and what has changed: states and static frames."""
        # 1. The clock, before what is stamped by it.
        if self._clock is not None and isinstance(message, self._clock) and message.stamp_ns > self._time_ns:
            self._time_ns = message.stamp_ns
            self._bus.publish(CLOCK, clock_cdr(self._encode.unix_ns(message.stamp_ns)))
        # 2. The message itself.
        attachment = _attachment(message).to_bytes() if isinstance(message, OdometryUpdate) else None
        for topic, _, payload in self._encode(message):
            self._bus.publish(topic, payload, attachment if topic == "odom" else None)
        # 3. Where they have changed: the state, and once the static frames.
        changed = [*self._states(message)] if isinstance(message, OdometryUpdate | PlaceUpdate) else []
        if isinstance(message, OdometryUpdate) and not self._gave_frames:
            self._gave_frames = True
            changed.append(static_frames(self._encode, message.stamp_ns))
        for topic, _, payload in changed:
            self._bus.publish(topic, payload)


def _attachment(odometry: OdometryUpdate) -> PoseAttachment:
    return PoseAttachment(
        odometry.seq, odometry.state, odometry.reset_counter, odometry.inliers, odometry.tracks, time.time_ns()
    )


class PanoramaSink:
    """Publishes the panorama of the lower camera as JPEG, at most rate_hz times a second, while it has a subscriber."""

    def __init__(self, bus: Bus, rate_hz: float, unix_ns: UnixTime = same_time) -> None:
        """unix_ns: the Encoder's."""
        self._bus, self._period_ns, self._unix_ns = bus, 1e9 / rate_hz, unix_ns
        self._next_ns = 0.0

    def process(self, odometry: OdometryUpdate) -> None:
        """Publish the panorama of a pose, with its features as the attachment, when it is due."""
        if odometry.stamp_ns < self._next_ns or not self._bus.is_received(PANORAMA):
            return
        # 1. Encode the panorama.
        self._next_ns = odometry.stamp_ns + self._period_ns
        _, jpeg = cv2.imencode(".jpg", odometry.depth.panoramas.lower.panorama)
        frame = Frame(odometry.seq, odometry.stamp_ns, "lower", "jpeg", jpeg)
        # 2. Publish it with its features.
        features = odometry.features
        pixels = {"inliers": features.inliers, "rejected": features.rejected, "new": features.new}
        _, payload = image_cdr(frame, self._unix_ns(odometry.stamp_ns))
        self._bus.publish(PANORAMA, payload, features_to_bytes(pixels))
