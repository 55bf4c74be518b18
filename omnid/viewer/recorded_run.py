"""A recording, shown as it stands: what is in it and nothing else; nothing is computed anew."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple

from drivers.errors import FrameDecodeError
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_info import LogInfo
from drivers.logs.mcap_messages import DataSection, LogMessage
from drivers.logs.mcap_records import LogFile, RecordError
from drivers.logs.ros_image import COMPRESSED_IMAGE, IMAGE, parse_image
from omnid.errors import OmnidError
from omnid.transport.codec import DIAGNOSTICS_SCHEMA, ODOMETRY_SCHEMA, POINT_CLOUD_SCHEMA
from omnid.transport.decode import Diagnostics, Pose, decode_cloud, decode_diagnostics, decode_pose
from omnid.viewer import status_plots as reports
from omnid.viewer.image_encoding import compressed
from omnid.viewer.rerun_scene import RerunScene

IMAGES: Final = ("panorama", "lower/image_raw/compressed", "lower/image_raw")  # whichever comes first
_LISTED: Final = 8


def poses_topic(found: LogInfo, robot: str | None) -> str | None:
    """The topic of a recording's poses, that of a robot where one is named; None where it has none.

    OmnidError where there are several, or none of the robot that was named.
    """
    every = [name for name, (kind, count) in found.topics.items() if kind == ODOMETRY_SCHEMA and count]
    mine = every if robot is None else [name for name in every if name.strip("/") == f"{robot}/odom"]
    listed = ", ".join(map(ascii, every[:_LISTED])) or "none"
    if robot is not None and not mine:
        raise OmnidError(f"{found.path}: no poses of a robot {robot!r}: found topics {listed}; leave out --robot, or "
                         "name one of these")
    if len(mine) > 1:
        raise OmnidError(f"{found.path}: the poses of several robots: {listed}; name one with --robot")
    return mine[0] if mine else None


class Way(NamedTuple):
    """How a message becomes something to see: what reads its bytes, and what draws that."""

    read: Callable[[memoryview], Any]
    draw: Callable[[Any], None]


class RecordedRunView:
    """Draws a recording; broken: messages that could not be read, damaged: pieces of the file."""

    def __init__(self, found: LogInfo, topic: str, board: RerunScene) -> None:
        self._found, self._board = found, board
        self._ways = self._by_topic(topic)
        self._pending: Pose | None = None  # until its state is known, which is written after it
        self._state, self._changes = "unknown", reports.StatusChanges()
        self.broken = self.damaged = 0

    @staticmethod
    def images(found: LogInfo, poses: str) -> str:
        """The topic of the images that are shown beside the poses of a topic; '' where there is none."""
        robot = poses.removesuffix("odom")
        return next((robot + name for name in IMAGES if robot + name in found.topics), "")

    def show(self) -> None:
        """Draws all of it."""
        for way, message in self._messages():
            try:
                found = way.read(message.data())
            except (OmnidError, FrameDecodeError, RecordError):
                self.broken += 1
                continue
            way.draw(found)
        self._settle()

    def _by_topic(self, poses: str) -> dict[str, dict[str, Way]]:
        """What becomes of a message, by its topic and type."""
        robot, images = poses.removesuffix("odom"), self.images(self._found, poses)
        return {
            poses: {ODOMETRY_SCHEMA: Way(lambda data: decode_pose(bytes(data), b"", 0), self._pose)},
            f"{robot}cloud": {POINT_CLOUD_SCHEMA: Way(lambda data: decode_cloud(bytes(data)), self._board.cloud)},
            f"{robot}status": {DIAGNOSTICS_SCHEMA: Way(lambda data: decode_diagnostics(bytes(data)), self._report)},
            images: {kind: Way(partial(self._image, kind), self._show) for kind in (IMAGE, COMPRESSED_IMAGE)},
        }

    def _messages(self) -> Iterator[tuple[Way, LogMessage]]:
        """What can be drawn, in the order of the file."""
        file = LogFile(self._found.path)
        try:
            section = DataSection(file, Catalog())
            for message in section.messages():
                topic = section.catalog.topic(message.channel_id)
                way = None if topic is None else self._ways.get(topic.name, {}).get(topic.type)
                if way is not None:
                    yield way, message
            self.damaged = section.broken + (not section.ended)
        finally:
            file.close()

    def _pose(self, pose: Pose) -> None:
        self._settle()
        self._pending = pose

    def _settle(self) -> None:
        """Draws the pose that waits, in the state that was told by now."""
        if self._pending is not None:
            attachment = replace(self._pending.attachment, state=self._state)
            self._board.pose(replace(self._pending, attachment=attachment))
        self._pending = None

    def _report(self, report: Diagnostics) -> None:
        self._state = reports.state(report) or self._state
        counts = reports.landmarks(report)
        if counts is not None:
            self._board.landmarks(report.stamp_ns, *counts)
        reports.draw(report, self._changes, self._board)

    def _image(self, kind: str, data: memoryview) -> tuple[int, bytes, str] | None:
        """Stamp, bytes and kind of a image; None unless it is wanted."""
        if not self._board.wants("image"):
            return None
        image = parse_image(kind, data)
        return image.stamp_ns, *compressed(image)

    def _show(self, image: tuple[int, bytes, str] | None) -> None:
        if image is not None:
            self._board.panorama(*image)
