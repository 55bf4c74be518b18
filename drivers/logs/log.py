"""A log: the messages of one or more files of any format, in the order of time, and what of them is missing.

A format states three things only (`LogFile`): where in a file which message is and when it was stamped, what bytes it
has, and what is attached. The places of all messages are collected first, some 60 bytes a message. So the order in a
file need not be the order in time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RecordError
from drivers.frame import Frame
from drivers.logs.compression import unpack_message
from drivers.logs.ros_messages import (
    STAMPED_TYPES,
    JointWheels,
    cdr_of_ros1,
    header_stamp,
    parse_image,
    parse_motion,
)
from drivers.motion import MotionSample

# Bounds of what is kept in memory, whatever a file states.
MAX_DEFINITIONS: Final = 4096  # topics, and types
MAX_DEFINITION_BYTES: Final = 2**20
MAX_ATTACHMENT_BYTES: Final = 16 * 2**20
MAX_NAME: Final = 256  # characters of a topic, a type or an attachment
MAX_LISTED: Final = 16  # names in a message
LATEST_NS: Final = 2**62  # A time beyond is none; the difference of two times fits 64 bits.

# When a message was logged, the stamp of its header if it begins with one (0 if unset), and where it is. In a file,
# messages are in the order of block and offset, whose meaning is the format's own.
ENTRY: Final = np.dtype([(name, np.int64) for name in ("channel", "time_ns", "header_ns", "block", "offset")])
Entries = NDArray[Any]  # (N,) of ENTRY


class Topic(NamedTuple):
    """Name and ROS type of the messages of a channel, such as sensor_msgs/msg/Image."""

    name: str
    kind: str  # "" where its messages cannot be decoded
    aligned: bool = True  # True: CDR (ROS 2); False: the serialisation of ROS 1


class LogFile(ABC):
    """An open file of messages, which may be damaged or malicious."""

    def __init__(self, name: str) -> None:
        """name: for messages."""
        self.name = name
        self.topics: dict[int, Topic] = {}  # by channel; complete after entries()
        self.faults: dict[int, str] = {}  # what cannot be read, by block, or by offset without one; grows by reading
        self.stated: Counter[int] = Counter()  # messages by channel, by the summary of a closed file, where it has one
        self.cut = ""  # one line that says what is missing at the end, "" of a complete file; known after entries()

    @abstractmethod
    def entries(self) -> Entries:
        """Return the places of all messages, in any order."""

    @abstractmethod
    def read(self, block: int, offset: int) -> bytes | memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; known after entries()."""
        return {}

    def header_ns(self, channel: int, start: bytes | memoryview) -> int:
        """Return the stamp in the first bytes of a message, or in all of one that is compressed by itself.

        0 where it is unset, or where the type has none that is used. Raise RecordError where it does not unpack.
        """
        topic = self.topics.get(channel)
        if topic is None or topic.kind not in STAMPED_TYPES:
            return 0
        return header_stamp(unpack_message(memoryview(start)), aligned=topic.aligned)

    def close(self) -> None:  # noqa: B027  (some keep no file open)
        """Close the file; may be called twice."""


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """A message as it was logged; what reads it raises FrameDecodeError where it is invalid."""

    topic: str
    kind: str  # ROS type such as sensor_msgs/msg/Image; "" where the message cannot be decoded
    log_time_ns: int
    logged: bytes | memoryview
    aligned: bool = True  # True: CDR (ROS 2); False: the serialisation of ROS 1

    def data(self) -> memoryview:
        """Return the bytes, unpacked where rosbag2 has compressed each message."""
        return unpack_message(memoryview(self.logged))

    def cdr(self) -> bytes:
        """Return the bytes in CDR."""
        return bytes(self.data()) if self.aligned else cdr_of_ros1(self.kind, self.data())

    def image(self) -> Frame:
        """Return the image of an image message, see `parse_image`."""
        return parse_image(self.kind, self.data(), aligned=self.aligned)

    def motion(self, joints: JointWheels | None) -> MotionSample | None:
        """Return the sample of wheels or an IMU, None of other joints."""
        return parse_motion(self.kind, self.data(), aligned=self.aligned, joints=joints)


class LogDamage(NamedTuple):
    """Faults that were found while a log was read."""

    broken: int = 0  # chunks and records that were skipped
    first: str = ""  # what is wrong with the first of them
    cut: str = ""  # one line that says where a log ends too early; empty for a complete log


class LogIndex(NamedTuple):
    """The places of all N messages, in the order of the files."""

    topics: Mapping[str, str]  # name -> type
    topic: NDArray[np.int32]  # (N,) index in topics
    file: NDArray[np.int16]  # (N,) index of the file
    entries: Entries
    order: NDArray[np.int64]  # (N,) rows in the order of log time, else of the files
    lost: Mapping[str, int]  # topic -> messages that a summary states, and that are nowhere


class Log:
    """An open log, which may be read several times."""

    def __init__(self, name: str, files: Sequence[LogFile], missing: Sequence[str] = ()) -> None:
        """name: for messages; files: the parts of the log in order; missing: names of those that are not there."""
        self.name, self.files, self._missing, self._closed = name, files, missing, False

    def topics(self) -> Mapping[str, str]:
        """Return name -> ROS type of all topics, such as sensor_msgs/msg/Image; '' where it cannot be decoded."""
        return self.index.topics

    def counts(self) -> Mapping[str, int]:
        """Return the number of messages of each topic."""
        numbers = np.bincount(self.index.topic, minlength=len(self.index.topics))
        return dict(zip(self.index.topics, numbers.tolist(), strict=True))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics (None: all) in the order of log time; ends early after close.

        Messages of one time are in the order of the file. Those that cannot be read are left out and counted.
        """
        for row in self.rows(topics).tolist():
            message = self.message(row)
            if self._closed:
                return
            if message is not None:
                yield message

    def rows(self, topics: Collection[str] | None = None) -> NDArray[np.int64]:
        """Return the rows of the index (N,) of the messages of these topics (None: all) in the order of log time."""
        wanted = [number for number, name in enumerate(self.index.topics) if topics is None or name in topics]
        return np.asarray(self.index.order[np.isin(self.index.topic[self.index.order], wanted)])

    def message(self, row: int) -> LoggedMessage | None:
        """Return the message of a row of the index; None, and count it, where it cannot be read."""
        index = self.index
        file, name = self.files[index.file[row]], self._names[index.topic[row]]
        channel, time_ns, _, block, offset = index.entries[row].item()
        try:
            data = file.read(block, offset)
        except RecordError as error:
            if not self._closed:
                file.faults.setdefault(block or offset, str(error))
            return None
        return LoggedMessage(name, index.topics[name], time_ns, data, file.topics[channel].aligned)

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments of the first file that has some, such as a rig.

        They have up to 16 MiB each, 64 MiB in all.
        """
        assert self.index
        return next((found for found in (file.attachments() for file in self.files) if found), {})

    def damage(self) -> LogDamage:
        """Return the faults that are known: all of them once messages() has ended."""
        assert self.index
        faults = [fault for file in self.files for fault in file.faults.values()]
        cuts = [file.cut for file in self.files if file.cut]
        if self._missing:
            cuts.insert(0, f"parts of the log {self.name!r} are missing: {listed(self._missing)}: used the others")
        return LogDamage(len(faults), faults[0] if faults else "", "; ".join(cuts))

    def close(self) -> None:
        """Close the files; may be called twice."""
        self._closed = True
        for file in self.files:
            file.close()

    @cached_property
    def _names(self) -> list[str]:
        return [*self.index.topics]

    @cached_property
    def index(self) -> LogIndex:
        """Where all messages are, and when they were logged."""
        # 1. The entries of each file in its order, with the numbers of their topics.
        topics, lost = dict[str, str](), Counter[str]()
        parts: list[tuple[Entries, NDArray[np.int32], NDArray[np.int16]]] = []
        for number, file in enumerate(self.files):
            entries = file.entries()
            entries = entries[np.lexsort((entries["offset"], entries["block"]))]
            for name, kind, _ in file.topics.values():
                topics[name] = topics.get(name) or kind
            places = {name: place for place, name in enumerate(topics)}
            channels, which, counts = np.unique(entries["channel"], return_inverse=True, return_counts=True)
            missing = file.stated - Counter(dict(zip(channels.tolist(), counts.tolist(), strict=True)))
            for channel in missing.keys() & file.topics.keys():
                lost[file.topics[channel].name] += missing[channel]
            known = np.array([places[file.topics[c].name] if c in file.topics else -1 for c in channels], np.int32)
            for channel in channels[known < 0]:
                file.faults[-1 - int(channel)] = f"the channel {channel} of messages is unknown"
            topic = known[which]
            is_known = topic >= 0
            parts.append((entries[is_known], topic[is_known], np.full(int(is_known.sum()), number, np.int16)))
        entries, topic, of_file = map(np.concatenate, zip(*parts, strict=True))
        # 2. The order of time.
        return LogIndex(topics, topic, of_file, entries, np.argsort(entries["time_ns"], kind="stable"), lost)


def listed(names: Iterable[str], none: str = "") -> str:
    """Return names in one line, with unprintable characters escaped; none: what stands for no names."""
    every = sorted(names)
    shown = ", ".join(name if name.isprintable() else ascii(name)[1:-1] for name in every[:MAX_LISTED])
    more = f" and {len(every) - MAX_LISTED} more" if len(every) > MAX_LISTED else ""
    return (shown or none) + more
