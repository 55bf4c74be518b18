"""View of a live robot, from its messages on the bus."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Final

from calib import se3
from drivers.errors import FrameDecodeError
from drivers.logs.ros_image import COMPRESSED_IMAGE, RosImage, parse_image
from omnid.client import Cloud, Diagnostics, Pose, Robot
from omnid.core.odometry.stereo_frame import Features
from omnid.engine.process import handle_stop_signals
from omnid.errors import OmnidError
from omnid.monitor.robot_state import Inbox, ReceivedMessage
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import PoseInMap, decode_cloud, decode_diagnostics, decode_map_pose, decode_pose
from omnid.transport.features_attachment import features_from_bytes
from omnid.transport.scan_codec import Scan, decode_scan
from omnid.viewer import status_plots
from omnid.viewer.rerun_scene import RerunScene
from omnid.viewer.targets import ViewerTarget

CONNECT_TIMEOUT_S: Final = 2.0
POLL_S: Final = 0.5  # Time between two checks for the end.
MOST_POSES: Final = 100


class RobotView:
    """Draws the messages of a robot; broken: messages that could not be decoded."""

    def __init__(self, scene: RerunScene) -> None:
        self._scene, self._changes = scene, status_plots.StatusChanges()
        self._poses: deque[Pose] = deque(maxlen=MOST_POSES)  # a pose in the map comes later than that in odom
        self.broken = 0

    def follow(self, bus: BusConfig, target: ViewerTarget, seconds: float | None) -> None:
        """Draw until a signal or the viewer's end, or for a number of seconds. Raise Unreachable without a robot."""
        end_s = math.inf if seconds is None else time.monotonic() + seconds
        signals: list[int] = []
        stopping = handle_stop_signals(lambda number, _: signals.append(number))
        with stopping, Robot(settings=bus, timeout_s=CONNECT_TIMEOUT_S) as robot:
            inbox = Inbox()
            robot.on_message(inbox.put)
            self._draw_latched(robot)
            while time.monotonic() < end_s and not signals and not target.closed:
                message = inbox.get(POLL_S)
                if message is not None:
                    self.process(message)

    def _draw_latched(self, robot: Robot) -> None:
        """Draw the status and the map that were published before this connection was made."""
        with robot.subscribe(Diagnostics) as reports:
            diagnostics = reports.newest()
        if diagnostics is not None:
            self._diagnostics(diagnostics)
        with robot.subscribe(Cloud) as clouds:
            cloud = clouds.newest()
        if cloud is not None:
            self._scene.cloud(cloud)

    def process(self, message: ReceivedMessage) -> None:
        """Draw a message, if it is of a kind that can be drawn."""
        # 1. Decode it; what is broken is counted.
        try:
            content = _decoded(message)
        except (OmnidError, FrameDecodeError):
            self.broken += 1
            return
        # 2. Draw it.
        match content:
            case Pose():
                self._scene.pose(content)
                self._poses.append(content)
                self._scene.latency(content.stamp_ns, ("age",), 1e-6 * (message.received_ns - content.stamp_ns))
            case PoseInMap():
                for pose in self._poses:
                    if pose.stamp_ns == content.stamp_ns:
                        self._scene.correction(pose.stamp_ns, content.T_map_base @ se3.inverse(pose.T_odom_base))
            case Diagnostics():
                self._diagnostics(content)
            case Cloud():
                self._scene.cloud(content)
            case Scan():
                self._scene.scan(content)
            case RosImage() if self._scene.wants("image"):
                self._scene.panorama(content.stamp_ns, bytes(content.data), content.encoding)
                self._features(content.stamp_ns, message.attachment)

    def _features(self, stamp_ns: int, attachment: bytes) -> None:
        """Draw the features of a panorama; images of other senders have none."""
        try:
            self._scene.features(stamp_ns, Features(**features_from_bytes(attachment)))
        except OmnidError:
            self.broken += bool(attachment)

    def _diagnostics(self, diagnostics: Diagnostics) -> None:
        status_plots.draw(diagnostics, self._changes, self._scene)


def _decoded(message: ReceivedMessage) -> Pose | PoseInMap | Diagnostics | Cloud | Scan | RosImage | None:
    """Return the content of a message, None for other topics; raise OmnidError or FrameDecodeError if it is broken."""
    match message.topic:
        case "odom":
            return decode_pose(message.payload, message.attachment, message.received_ns)
        case "map_pose":
            return decode_map_pose(message.payload)
        case "status":
            return decode_diagnostics(message.payload)
        case "cloud":
            return decode_cloud(message.payload)
        case "scan":
            return decode_scan(message.payload)
        case "panorama":
            return parse_image(COMPRESSED_IMAGE, memoryview(message.payload))
    return None
