"""A bag of ROS 1 (.bag, format 2.0), read by rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

from rosbags.rosbag1 import Reader

from drivers.errors import DriverError
from drivers.logs.log import LogDamage, LoggedMessage

MAGIC: Final = b"#ROSBAG V2.0\n"
_MAX_REASON: Final = 120  # characters


class Ros1Bag:
    """A Log of one .bag file; raises DriverError where it cannot be opened.

    rosbags trusts the lengths in a file and raises errors of any kind for a damaged one: all count as damage.
    """

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._damage, self._closed = LogDamage(), False
        self._reader = Reader(path)
        try:
            self._reader.open()
            self._topics = {name: found.msgtype or "" for name, found in self._reader.topics.items()}
            self._counts = {name: found.msgcount for name, found in self._reader.topics.items()}
        except Exception as error:
            raise DriverError(
                f"cannot read the bag {self.name!r}: {_line(error)}; if it was cut, `rosbag reindex` mends it"
            ) from error

    def topics(self) -> Mapping[str, str]:
        """Return name -> type of all topics."""
        return self._topics

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic by the index."""
        return self._counts

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time by the index; None without messages."""
        return (self._reader.start_time, self._reader.end_time - 1) if any(self._counts.values()) else None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics in the order of log time."""
        wanted = [connection for connection in self._reader.connections if topics is None or connection.topic in topics]
        self._damage = LogDamage()
        count = 0
        try:
            for connection, time_ns, data in self._reader.messages(wanted) if wanted else ():
                count += 1
                yield LoggedMessage(connection.topic, connection.msgtype, time_ns, partial(bytes, data), aligned=False)
                if self._closed:
                    return
        except Exception as error:
            line = f"the bag {self.name!r} is corrupt after {count} messages ({_line(error)}): used those before"
            self._damage = LogDamage(cut=line)

    def attachments(self) -> dict[str, bytes]:
        """Return none: a bag has no attachments."""
        return {}

    def damage(self) -> LogDamage:
        """Return the faults found by the last call of messages()."""
        return self._damage

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._closed = True
        with suppress(Exception):  # it is closed already
            self._reader.close()


def _line(error: Exception) -> str:
    """Return an error in one line."""
    return " ".join(str(error).split())[:_MAX_REASON] or type(error).__name__
