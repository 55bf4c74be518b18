"""A log: the messages of one or more files of any format, in the order of time.

A format states three things only (`LogFile`): where in a file which message is and when it was stamped, what bytes it
has, and what is attached. The places of all messages are collected first, some 60 bytes a message. So the order in a
file need not be the order in time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from drivers.errors import RecordError
from drivers.logs.ros_messages import STAMPED_TYPES, header_stamp

# Bounds of what is kept in memory, whatever a file states.
MAX_RECORD_BYTES: Final = 256 * 2**20  # of a message, of an image and of an unpacked chunk
KEPT_CHUNKS: Final = 4  # that stay unpacked: both cameras, wheels and gyro may have been written one after the other
LATEST_NS: Final = 2**62  # Later times are invalid; the difference of two times fits 64 bits.
ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a frame (RFC 8878); no message begins with them

# When a message was logged, the stamp of its header if it begins with one (0 if unset), and where it is. In a file,
# messages are in the order of block and offset, whose meaning is the format's own.
ENTRY: Final = np.dtype([(name, np.int64) for name in ("channel", "time_ns", "header_ns", "block", "offset")])
Entries = NDArray[Any]  # (N,) of ENTRY


class Topic(NamedTuple):
    """Name and ROS type of the messages of a channel, such as sensor_msgs/msg/Image."""

    name: str
    kind: str  # "" where its messages cannot be decoded


class LogFile(ABC):
    """An open file of messages, which may be damaged or malicious."""

    magic: ClassVar[bytes]  # with which a file of the format begins

    def __init__(self, path: Path) -> None:
        self.name = str(path)  # for messages
        self.topics: dict[int, Topic] = {}  # by channel; complete after entries()
        self.faults: dict[int, str] = {}  # what cannot be read, by block, or by offset without one; grows by reading
        self.cut = ""  # one line that says what is missing at the end, "" of a complete file; known after entries()

    @abstractmethod
    def entries(self) -> Entries:
        """Return the places of all messages of known topics, in any order."""

    @abstractmethod
    def read(self, channel: int, block: int, offset: int) -> bytes | memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; known after entries()."""
        return {}

    def header_ns(self, channel: int, start: bytes | memoryview) -> int:
        """Return the stamp in the first bytes of a message, or in all of one that is compressed by itself.

        0 where it is unset, or where the type has none that is used. Raise RecordError where it does not unpack, or the
        channel is unknown.
        """
        if channel not in self.topics:
            raise RecordError(f"the channel {channel} of messages is unknown")
        is_stamped = self.topics[channel].kind in STAMPED_TYPES
        return header_stamp(unpack_message(memoryview(start))) if is_stamped else 0

    @abstractmethod
    def close(self) -> None:
        """Close the file; may be called twice."""


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """A message as it was logged."""

    topic: str
    kind: str  # ROS type such as sensor_msgs/msg/Image; "" where the message cannot be decoded
    data: memoryview  # CDR


class Log:
    """An open log, which may be read several times.

    path, size_bytes: of the file or the folder. topics: name -> ROS type, such as sensor_msgs/msg/Image; '' where it
    cannot be decoded. entries, topic, file (N,): the places of all messages in the order of the files, their indices in
    topics and files.
    """

    def __init__(self, path: Path, files: Sequence[LogFile]) -> None:
        """files: the parts of the log in order."""
        self.path, self.files, self._closed, self.topics = path, files, False, dict[str, str]()
        self.size_bytes = sum(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())
        found, topics = list[Entries](), list[int]()
        for file in files:
            entries = file.entries()
            found.append(entries[np.lexsort((entries["offset"], entries["block"]))])
            for each in file.topics.values():
                self.topics[each.name] = self.topics.get(each.name) or each.kind
            self._names = [*self.topics]
            topics += [self._names.index(file.topics[channel].name) for channel in found[-1]["channel"].tolist()]
        self.entries, self.topic = np.concatenate(found), np.array(topics, np.int64)
        self.file = np.repeat(np.arange(len(files)), [*map(len, found)])

    def counts(self) -> dict[str, int]:
        """Return the number of messages of each topic."""
        numbers = np.bincount(self.topic, minlength=len(self.topics))
        return dict(zip(self.topics, numbers.tolist(), strict=True))

    def rows(self, topics: Collection[str]) -> NDArray[np.int64]:
        """Return the rows of the entries (N,) of the messages of these topics, in the order of the files."""
        return np.flatnonzero(np.isin(self.topic, [n for n, name in enumerate(self._names) if name in topics]))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics (None: all) in the order of log time; ends early after close.

        Messages of one time are in the order of the files. Those that cannot be read are left out and counted.
        """
        rows = self.rows(self.topics if topics is None else topics)
        for row in rows[np.argsort(self.entries["time_ns"][rows], kind="stable")].tolist():
            message = self.message(row)
            if self._closed:
                return
            if message is not None:
                yield message

    def message(self, row: int) -> LoggedMessage | None:
        """Return the message of a row of the entries; None, and count it, where it cannot be read."""
        file, name = self.files[self.file[row]], self._names[self.topic[row]]
        channel, _, _, block, offset = self.entries[row].item()
        try:
            data = unpack_message(memoryview(file.read(channel, block, offset)))
        except RecordError as error:
            if not self._closed:
                file.faults.setdefault(block or offset, str(error))
            return None
        return LoggedMessage(name, self.topics[name], data)

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments of the first file that has some, such as a rig."""
        return next((found for found in (file.attachments() for file in self.files) if found), {})

    @property
    def state(self) -> str:
        """Words for its state; what is broken within an image or a row of a database shows when it is read."""
        return "cut or corrupt" if self.cut or self.faults else "whole"

    @property
    def faults(self) -> list[str]:
        """What is wrong with the chunks and records that were skipped: all of them once messages() has ended."""
        return [fault for file in self.files for fault in file.faults.values()]

    @property
    def cut(self) -> str:
        """One line that says where the log ends too early; empty for a complete log."""
        return "; ".join(file.cut for file in self.files if file.cut)

    def close(self) -> None:
        """Close the files; may be called twice."""
        self._closed = True
        for file in self.files:
            file.close()


def unpack_message(data: memoryview) -> memoryview:
    """Return a message, unpacked where rosbag2 has compressed each message; raise RecordError where it is damaged."""
    if bytes(data[: len(ZSTD)]) != ZSTD:
        return data
    try:
        if zstandard.frame_content_size(data) > MAX_RECORD_BYTES:
            raise RecordError(f"it unpacks to more than {MAX_RECORD_BYTES} bytes")
        return memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_RECORD_BYTES))
    except (zstandard.ZstdError, MemoryError) as error:
        raise RecordError(f"it does not unpack: {error}") from error


def listed(names: Iterable[str], none: str = "", max_count: int = 16) -> str:
    """Return names in one line, at most so many, with unprintable characters escaped; none: the text for no names."""
    every = sorted(names)
    shown = ", ".join(name if name.isprintable() else ascii(name)[1:-1] for name in every[:max_count])
    return (shown or none) + (f" and {len(every) - max_count} more" if len(every) > max_count else "")
