"""A robot as it drives, heard on the bus."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Final, TypeVar

from drivers.errors import BrokenFrame
from drivers.logs.ros_image import COMPRESSED_IMAGE, RosImage, parse_image
from omnid.client import Cloud, Pose, Report, Robot
from omnid.core.odometry.stereo_frame import Features
from omnid.engine.signals import ended_by_signals
from omnid.errors import OmnidError
from omnid.monitor.robot_state import Inbox, ReceivedMessage
from omnid.transport.bus_config import BusConfig
from omnid.transport.decode import cloud_from, pose_from, report_from
from omnid.transport.features_attachment import features_from_bytes
from omnid.viewer import status_plots as reports
from omnid.viewer.rerun_scene import RerunScene
from omnid.viewer.targets import ViewerTarget

T = TypeVar("T")
PATIENCE_S: Final = 2.0
LOOKS_S: Final = 0.5  # between two looks whether anybody is there still


class LiveRobotView:
    """Draws what comes of a robot; broken: messages that could not be read."""

    def __init__(self, board: RerunScene) -> None:
        self._board, self._changes = board, reports.Changes()
        self.broken = 0

    def follow(self, bus: BusConfig, place: ViewerTarget, seconds: float | None) -> None:
        """Draws until a signal, until nobody looks any more, or for so many seconds. Unreachable where nobody answers.
        """
        end_s = math.inf if seconds is None else time.monotonic() + seconds
        signals: list[int] = []
        stopping = ended_by_signals(lambda number, _: signals.append(number))
        with stopping, Robot(settings=bus, patience_s=PATIENCE_S) as robot:
            mailbox = Inbox()
            robot.each(mailbox.take)
            self._late(robot)
            while time.monotonic() < end_s and not signals and not place.left:
                letter = mailbox.next(LOOKS_S)
                if letter is not None:
                    self.take(letter)

    def _late(self, robot: Robot) -> None:
        """What was said before we came."""
        for report in _newest(robot, Report):
            self._report(report)
        for cloud in _newest(robot, Cloud):
            self._board.cloud(cloud)

    def take(self, letter: ReceivedMessage) -> None:
        """Draws a message, if it can be drawn."""
        try:
            message = _read(letter)
        except (OmnidError, BrokenFrame):
            self.broken += 1
            return
        match message:
            case Pose():
                self._board.pose(message)
                self._board.latency(message.stamp_ns, ("age",), 1e-6 * (letter.received_ns - message.stamp_ns))
            case Report():
                self._report(message)
            case Cloud():
                self._board.cloud(message)
            case RosImage() if self._board.wants("image"):
                self._board.panorama(message.stamp_ns, bytes(message.data), message.encoding)
                self._features(message.stamp_ns, letter.note)

    def _features(self, stamp_ns: int, note: bytes) -> None:
        """Draws what goes along with a panorama; others than omnid may send images without."""
        try:
            self._board.features(stamp_ns, Features(**features_from_bytes(note)))
        except OmnidError:
            self.broken += bool(note)

    def _report(self, report: Report) -> None:
        reports.draw(report, self._changes, self._board)


def _read(letter: ReceivedMessage) -> Pose | Report | Cloud | RosImage | None:
    """The message in a letter, if it is of a kind that can be drawn; OmnidError or BrokenFrame where it is broken."""
    match letter.topic:
        case "odom":
            return pose_from(letter.payload, letter.note, letter.received_ns)
        case "status":
            return report_from(letter.payload)
        case "cloud":
            return cloud_from(letter.payload)
        case "panorama":
            return parse_image(COMPRESSED_IMAGE, memoryview(letter.payload))
    return None


def _newest(robot: Robot, kind: type[T]) -> Iterator[T]:
    """The newest of a kind that a robot has said, if any."""
    subscription = robot.subscribe(kind)
    newest = subscription.newest()
    subscription.close()
    if newest is not None:
        yield newest
