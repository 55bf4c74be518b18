"""A recording, shown as it stands: what is in it and nothing else; nothing is computed anew."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final, TypeAlias

from drivers.errors import BrokenFrame
from drivers.mcap_catalog import Catalog
from drivers.mcap_messages import DataSection
from drivers.mcap_records import LogFile, RecordError
from drivers.mcap_survey import Survey
from drivers.ros_image import COMPRESSED_IMAGE, IMAGE, parse_image
from omnid.errors import OmnidError
from omnid.transport.codec import DIAGNOSTICS_SCHEMA, ODOMETRY_SCHEMA, POINT_CLOUD_SCHEMA
from omnid.transport.decode import Pose, cloud_from, pose_from, report_from
from omnid.viewing import reports
from omnid.viewing.board import Board
from omnid.viewing.pictures import compressed

Taker: TypeAlias = Callable[[str, memoryview], None]  # of the type and the bytes of a message
PICTURES: Final = ("panorama", "lower/image_raw/compressed", "lower/image_raw")  # whichever comes first
_LISTED: Final = 8


def poses_topic(found: Survey, robot: str | None) -> str | None:
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


class Recorded:
    """Draws a recording; broken: messages that could not be read, damaged: pieces of the file."""

    def __init__(self, found: Survey, topic: str, board: Board) -> None:
        self._found, self._board = found, board
        self._takers = self._by_topic(topic)
        self._pending: Pose | None = None  # until its state is known, which is written after it
        self._state, self._changes = "unknown", reports.Changes()
        self.broken = self.damaged = 0

    @staticmethod
    def pictures(found: Survey, poses: str) -> str:
        """The topic of the pictures that are shown beside the poses of a topic; '' where there is none."""
        robot = poses.removesuffix("odom")
        return next((robot + name for name in PICTURES if robot + name in found.topics), "")

    def show(self) -> None:
        """Draws all of it."""
        for kind, topic, data in self._messages():
            try:
                self._takers[topic][kind](kind, data)
            except (OmnidError, BrokenFrame):
                self.broken += 1
        self._settle()

    def _by_topic(self, poses: str) -> dict[str, dict[str, Taker]]:
        """What draws a message, by its topic and type."""
        robot, pictures = poses.removesuffix("odom"), self.pictures(self._found, poses)
        return {
            poses: {ODOMETRY_SCHEMA: self._pose},
            f"{robot}cloud": {POINT_CLOUD_SCHEMA: self._cloud},
            f"{robot}status": {DIAGNOSTICS_SCHEMA: self._report},
            pictures: {IMAGE: self._picture, COMPRESSED_IMAGE: self._picture},
        }

    def _messages(self) -> Iterator[tuple[str, str, memoryview]]:
        """Type, topic and bytes of what can be drawn, in the order of the file."""
        file = LogFile(self._found.path)
        try:
            section = DataSection(file, Catalog())
            for message in section.messages():
                topic = section.catalog.topic(message.channel_id)
                if topic is not None and topic.type in self._takers.get(topic.name, {}):
                    try:
                        yield topic.type, topic.name, message.data()
                    except RecordError:
                        self.broken += 1
            self.damaged = section.broken + (not section.ended)
        finally:
            file.close()

    def _pose(self, _: str, data: memoryview) -> None:
        pose = pose_from(bytes(data), b"", 0)
        self._settle()
        self._pending = pose

    def _settle(self) -> None:
        """Draws the pose that waits, in the state that was told by now."""
        if self._pending is not None:
            note = replace(self._pending.note, state=self._state)
            self._board.pose(replace(self._pending, note=note))
        self._pending = None

    def _report(self, _: str, data: memoryview) -> None:
        report = report_from(bytes(data))
        self._state = reports.state(report) or self._state
        reports.draw(report, self._changes, self._board)

    def _cloud(self, _: str, data: memoryview) -> None:
        self._board.cloud(cloud_from(bytes(data)))

    def _picture(self, kind: str, data: memoryview) -> None:
        if self._board.wants("picture"):
            image = parse_image(kind, data)
            self._board.panorama(image.stamp_ns, *compressed(image))
