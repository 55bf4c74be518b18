"""The images of an MCAP log, complete or damaged, without its index: by ROS 2, or converted from ROS 1."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import partial

from drivers.logs.image_log import LogDamage, LoggedImage, LoggedMotion
from drivers.logs.joint_wheels import JointWheels
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_index import has_footer, read_attachments, read_summary
from drivers.logs.mcap_messages import DataSection, LogMessage, scan_channels
from drivers.logs.mcap_records import LogFile
from drivers.logs.ros_image import IMAGE_TYPES, RosImage, parse_image
from drivers.logs.ros_motion import MOTION_TYPES, MotionReading, parse_motion


class McapImageLog:
    """An ImageLog of one MCAP file; raises DriverError where the path is not one."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = LogFile(path)
        self.name = str(self._file.path)
        self._summary = read_summary(self._file)
        self._catalog = self._known_channels()
        self._damage = LogDamage()

    def topics(self) -> Mapping[str, str]:
        """Return name -> type, from the summary or from the start of the file."""
        return self._catalog.topics()

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic by the statistics, None without them."""
        if self._summary is None or not self._summary.message_counts:
            return None
        catalog, counts = self._summary.catalog, self._summary.message_counts
        return {name: sum(counts.get(channel, 0) for channel in catalog.ids(name)) for name in catalog.topics()}

    def messages(self) -> Iterator[LoggedImage | LoggedMotion]:
        """Yield the messages in file order."""
        section = DataSection(self._file, self._catalog)
        for message in section.messages():
            topic = self._catalog.topic(message.channel_id)
            if topic is not None and topic.type in IMAGE_TYPES:
                yield LoggedImage(topic.name, message.log_time_ns, partial(_read, topic.type, message, topic.aligned))
            elif topic is not None and topic.type in MOTION_TYPES:
                yield LoggedMotion(
                    topic.name, message.log_time_ns, partial(_read_motion, topic.type, message, topic.aligned)
                )
            if self._file.closed:
                return
        complete = section.ended and has_footer(self._file)
        self._damage = LogDamage(
            section.broken,
            ""
            if complete
            else f"the log {self.name!r} is cut or corrupt after byte {section.position} of "
            f"{self._file.size}: used the data before",
        )

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments."""
        return read_attachments(self._file, self._summary)

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages()."""
        return self._damage

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _known_channels(self) -> Catalog:
        """Return the channels from the summary; of a truncated log, which has none, from the start of the file."""
        if self._summary is not None and self._summary.catalog.topics():
            return self._summary.catalog
        return scan_channels(self._file)


def _read(kind: str, message: LogMessage, aligned: bool) -> RosImage:
    return parse_image(kind, message.data(), aligned=aligned)


def _read_motion(kind: str, message: LogMessage, aligned: bool, joints: JointWheels | None) -> MotionReading:
    return parse_motion(kind, message.data(), aligned=aligned, joints=joints)
