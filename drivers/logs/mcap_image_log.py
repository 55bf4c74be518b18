"""The images of an MCAP log, complete or damaged, without its index: by ROS 2, or converted from ROS 1."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping

from drivers.logs.image_log import LogDamage, LoggedImage, LoggedMotion, logged_message
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_index import has_footer, read_attachments, read_summary
from drivers.logs.mcap_messages import DataSection, scan_channels
from drivers.logs.mcap_records import LogFile


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
            if topic is not None:
                kind, time_ns = topic.type, message.log_time_ns
                logged = logged_message(topic.name, kind, time_ns, message.data, aligned=topic.aligned)
                if logged is not None:
                    yield logged
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
