"""A log: the messages of one or more files of any format, in the order of time, and what is wrong with the files.

A format says only where in a file which message is, and what bytes it has (`LogFile`). The places of all messages are
collected first, some 50 bytes a message. So the order in a file need not be the order in time, and a step of the
recorder's clock is found before anything is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import zstandard
from numpy.typing import NDArray

from drivers.logs.ros_messages import (
    IMAGE_TYPES,
    JointWheels,
    RosImage,
    cdr_of_ros1,
    parse_image,
    parse_motion,
)
from drivers.motion import MotionSample

# Bounds of what is kept in memory, whatever a file states.
MAX_RECORD_BYTES: Final = 256 * 2**20  # of a message, of an image and of an unpacked chunk
MAX_DEFINITIONS: Final = 4096  # topics, and types
MAX_DEFINITION_BYTES: Final = 2**20
MAX_ATTACHMENT_BYTES: Final = 16 * 2**20
MAX_NAME: Final = 256  # characters of a topic, a type or an attachment
MAX_LISTED: Final = 16  # names in a message
LATEST_NS: Final = 2**62  # A time beyond is none; the difference of two times fits 64 bits.
FEWEST_IN_ORDER: Final = 8  # Where fewer messages of a topic follow each other on average, it is written out of order.
LONGEST_STEP: Final = 1.5  # Where two messages are more periods apart than that, one is missing between them.
FAR_STEPS: Final = 3  # Times that end so many periods before others are of another clock.
_ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a frame (RFC 8878); no message begins with them

# Where a message is. In a file, messages are in the order of block and offset, whose meaning is the format's own.
ENTRY: Final = np.dtype([(name, np.int64) for name in ("channel", "time_ns", "block", "offset")])
Entries = NDArray[Any]  # (N,) of ENTRY


class RecordError(Exception):
    """A record or a message with invalid content; those after it may be valid. The text identifies the record."""


class Topic(NamedTuple):
    """Name and ROS type of the messages of a channel, such as sensor_msgs/msg/Image."""

    name: str
    kind: str  # "" where its messages cannot be decoded
    aligned: bool = True  # True: CDR (ROS 2); False: the serialisation of ROS 1


class LogFile(Protocol):
    """An open file of messages, which may be damaged or malicious."""

    topics: dict[int, Topic]  # by channel; complete after entries()
    faults: Counter[str]  # what is wrong with single records -> number of tries to read one; grows by reading
    cut: str  # one line that says where the file ends too early, "" of a complete one; known after entries()
    is_indexed: bool  # other programs can read it without a search for its messages

    def entries(self) -> Iterator[Entries]:
        """Yield the places of all messages, in any order."""

    def read(self, channel: int, time_ns: int, block: int, offset: int) -> bytes | memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; known after entries()."""

    def close(self) -> None:
        """Close the file; may be called twice."""


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """A message as it was logged."""

    topic: str
    kind: str  # ROS type such as sensor_msgs/msg/Image; "" where the message cannot be decoded
    log_time_ns: int
    logged: bytes | memoryview
    aligned: bool = True  # True: CDR (ROS 2); False: the serialisation of ROS 1

    def data(self) -> memoryview:
        """Return the bytes, unpacked where rosbag2 has compressed each message; raise RecordError."""
        data = memoryview(self.logged)
        return unpack_zstd(data) if bytes(data[: len(_ZSTD)]) == _ZSTD else data

    def cdr(self) -> bytes:
        """Return the bytes in CDR; raise RecordError or FrameDecodeError."""
        return bytes(self.data()) if self.aligned else cdr_of_ros1(self.kind, self.data())

    def image(self) -> RosImage:
        """Return the image of an image message; raise FrameDecodeError or RecordError where there is none."""
        return parse_image(self.kind, self.data(), aligned=self.aligned)

    def motion(self, joints: JointWheels | None) -> MotionSample | None:
        """Return the sample of wheels or an IMU, None of other joints; raise FrameDecodeError or RecordError."""
        return parse_motion(self.kind, self.data(), aligned=self.aligned, joints=joints)


class LogDamage(NamedTuple):
    """Faults that were found while a log was read."""

    broken: int = 0  # chunks and records that were skipped
    first: str = ""  # what is wrong with the first of them
    cut: str = ""  # one line that says where a log ends too early; empty for a complete log


class _Index(NamedTuple):
    """The places of all N messages, in the order of the files."""

    topics: Mapping[str, str]  # name -> type
    topic: NDArray[np.int32]  # (N,) index in topics
    file: NDArray[np.int16]  # (N,) index of the file
    entries: Entries
    order: NDArray[np.int64]  # (N,) rows in the order of time


class Log:
    """An open log, which may be read several times.

    Within a file, and from one part to the next, the recorder's clock may have been set back: the messages after such a
    step follow those before it.
    """

    def __init__(self, name: str, files: Sequence[LogFile], missing: Sequence[str] = ()) -> None:
        """name: for messages; files: the parts of the log in order; missing: names of those that are not there."""
        self.name, self._files, self._missing, self._closed = name, files, missing, False

    def topics(self) -> Mapping[str, str]:
        """Return name -> ROS type of all topics, such as sensor_msgs/msg/Image; '' where it cannot be decoded."""
        return self._index.topics

    def counts(self) -> Mapping[str, int]:
        """Return the number of messages of each topic."""
        numbers = np.bincount(self._index.topic, minlength=len(self._index.topics))
        return dict(zip(self._index.topics, numbers.tolist(), strict=True))

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time; None without messages."""
        times = self._index.entries["time_ns"]
        return (int(times.min()), int(times.max())) if times.size else None

    @property
    def is_indexed(self) -> bool:
        """True if other programs, too, can read all files without a search for their messages."""
        return all(file.is_indexed for file in self._files)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics (None: all) in the order of log time; ends early after close.

        Messages of one time are in the order of the file. Those that cannot be read are left out and counted.
        """
        names, kinds = [*self._index.topics], [*self._index.topics.values()]
        wanted = [number for number, name in enumerate(names) if topics is None or name in topics]
        rows = self._index.order[np.isin(self._index.topic[self._index.order], wanted)]
        for row, number in zip(rows.tolist(), self._index.topic[rows].tolist(), strict=True):
            if self._closed:
                return
            file, entry = self._files[self._index.file[row]], self._index.entries[row].item()
            try:
                data = file.read(*entry)
            except RecordError as error:
                if not self._closed:
                    file.faults[str(error)] += 1
                continue
            yield LoggedMessage(names[number], kinds[number], entry[1], data, file.topics[entry[0]].aligned)

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments of the first file that has some, such as a rig.

        They have up to 16 MiB each, 64 MiB in all.
        """
        assert self._index
        return next((found for found in (file.attachments() for file in self._files) if found), {})

    def damage(self) -> LogDamage:
        """Return the faults that are known: all of them once messages() has ended."""
        assert self._index
        faults = [fault for file in self._files for fault in file.faults]
        cuts = [file.cut for file in self._files if file.cut]
        if self._missing:
            more = f" and {len(self._missing) - MAX_LISTED} more" if len(self._missing) > MAX_LISTED else ""
            listed = ascii(", ".join(self._missing[:MAX_LISTED]))[1:-1]
            cuts.insert(0, f"parts of the log {self.name!r} are missing: {listed}{more}: used the others")
        return LogDamage(len(faults), faults[0] if faults else "", "; ".join(cuts))

    def close(self) -> None:
        """Close the files; may be called twice."""
        self._closed = True
        for file in self._files:
            file.close()

    @cached_property
    def _index(self) -> _Index:
        # 1. Where the messages are.
        topics: dict[str, str] = {}
        found: list[tuple[Entries, NDArray[np.int32]]] = []
        for file in self._files:
            entries = np.concatenate([np.empty(0, ENTRY), *file.entries()])
            block, offset = entries["block"], entries["offset"]
            if np.any((block[1:] < block[:-1]) | ((block[1:] == block[:-1]) & (offset[1:] < offset[:-1]))):
                entries = entries[np.lexsort((offset, block))]
            for name, kind, _ in file.topics.values():
                topics[name] = topics.get(name) or kind
            places = {name: place for place, name in enumerate(topics)}
            channels, which = np.unique(entries["channel"], return_inverse=True)
            known = np.array([places[file.topics[c].name] if c in file.topics else -1 for c in channels], np.int32)
            for channel in channels[known < 0]:
                file.faults[f"the channel {channel} of messages is unknown"] += 1
            numbers = known[which]
            found.append((entries, numbers) if (known >= 0).all() else (entries[numbers >= 0], numbers[numbers >= 0]))
        entries, topic = found[0] if len(found) == 1 else map(np.concatenate, zip(*found, strict=True))
        of_file = np.repeat(np.arange(len(found), dtype=np.int16), [len(numbers) for _, numbers in found])
        # 2. Their order: by time within a segment, else by place in the file, as the sort is stable.
        images = [place for place, kind in enumerate(topics.values()) if kind in IMAGE_TYPES]
        segments = _segments(topic, entries["time_ns"], images)
        return _Index(topics, topic, of_file, entries, np.lexsort((entries["time_ns"], segments)))


def _segments(topic: NDArray[np.int32], times: NDArray[np.int64], images: Iterable[int]) -> NDArray[np.int64]:
    """Return the segment of each message (N,): between two of them the recorder's clock was set back.

    topic, times: (N,) in the order of the files. images: the topics that decide; others follow the first of them.
    """
    cuts = {}
    for number in images:
        rows = np.flatnonzero(topic == number)
        if (steps := steps_back(times[rows])).size:
            cuts[number] = rows[steps]
    segments = np.zeros(len(topic), np.int64)
    if cuts:
        first = min(cuts.values(), key=lambda rows: int(rows[0]))
        for number in np.unique(topic).tolist():
            rows = np.flatnonzero(topic == number)
            segments[rows] = np.searchsorted(cuts.get(number, first), rows, "right")
    return segments


def steps_back(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices in the times of one topic, in the order of the file, at which its clock was set back.

    A file may also be written out of order: then what comes late fits into holes, or times go back at every
    few messages. After a step, times are covered again that were covered before, or others that lie far from them.
    """
    increments = np.diff(times)
    back = np.flatnonzero(increments < 0) + 1
    if not back.size or FEWEST_IN_ORDER * back.size > increments.size:
        return back[:0]
    period = float(np.median(increments[increments > 0]))
    starts, low, high = [0], times[0], times[back[0] - 1]  # begins of segments; first and last time of the newest one
    for at, end in pairwise([*back.tolist(), len(times)]):
        run = times[at:end]  # which ascends
        within = run[np.searchsorted(run, low) : np.searchsorted(run, high, "right")]
        is_step = bool(run[-1] < low - FAR_STEPS * period)
        if within.size > 1 or (within.size and run.size >= FEWEST_IN_ORDER):
            segment = times[starts[-1] : at]
            before = np.sort(segment[segment > within[0] - LONGEST_STEP * period])
            behind = np.searchsorted(before, within)
            again = np.count_nonzero((behind > 0) & (before[behind] - before[behind - 1] < LONGEST_STEP * period))
            is_step = is_step or bool(again > within.size / 2)
        if is_step:
            starts.append(at)
        low, high = (run[0], run[-1]) if is_step else (min(low, run[0]), max(high, run[-1]))
    return np.array(starts[1:], np.int64)


def unpack_zstd(data: bytes | memoryview) -> memoryview:
    """Return the content of a frame of zstd; raise RecordError where it is damaged or larger than MAX_RECORD_BYTES."""
    try:
        stated = zstandard.get_frame_parameters(data).content_size
        size = MAX_RECORD_BYTES if stated == zstandard.CONTENTSIZE_UNKNOWN else stated
        if size > MAX_RECORD_BYTES:
            raise RecordError(f"it unpacks to {size} bytes, more than {MAX_RECORD_BYTES}")
        unpacked = zstandard.ZstdDecompressor().stream_reader(data).read(size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise RecordError(f"it does not unpack: {error}") from error
    if stated == size and len(unpacked) < size:
        raise RecordError(f"it unpacks to {len(unpacked)} of {size} bytes")
    return memoryview(unpacked)
