"""A log in any format: what all readers of logs offer, and the contents that `omnid log info` shows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import zstandard

from drivers.logs.ros_messages import JointWheels, MotionReading, RosImage, cdr_of_ros1, parse_image, parse_motion

MAX_RECORD_BYTES: Final = 256 * 2**20  # of a message, of an image and of an unpacked chunk
_ZSTD: Final = b"\x28\xb5\x2f\xfd"  # first bytes of a frame (RFC 8878); no message begins with them


class RecordError(Exception):
    """A record or a message with invalid content; those after it may be valid."""


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """A message that is not yet read."""

    topic: str
    kind: str  # ROS type such as sensor_msgs/msg/Image; "" where the message cannot be decoded
    log_time_ns: int
    read: Callable[[], bytes | memoryview]  # raises RecordError where the bytes cannot be read
    aligned: bool = True  # True: CDR (ROS 2); False: the serialisation of ROS 1

    def data(self) -> memoryview:
        """Return the bytes, unpacked where rosbag2 has compressed each message; raise RecordError."""
        data = memoryview(self.read())
        return unpack_zstd(data) if bytes(data[: len(_ZSTD)]) == _ZSTD else data

    def cdr(self) -> bytes:
        """Return the bytes in CDR; raise RecordError or FrameDecodeError."""
        return bytes(self.data()) if self.aligned else cdr_of_ros1(self.kind, self.data())

    def image(self) -> RosImage:
        """Return the image of an image message; raise FrameDecodeError or RecordError where there is none."""
        return parse_image(self.kind, self.data(), aligned=self.aligned)

    def motion(self, joints: JointWheels | None) -> MotionReading:
        """Return the rates of a message of wheels or an IMU; raise FrameDecodeError or RecordError."""
        return parse_motion(self.kind, self.data(), aligned=self.aligned, joints=joints)


class LogDamage(NamedTuple):
    """Faults that were found while a log was read."""

    broken: int = 0  # chunks and records that were skipped
    cut: str = ""  # one line that says where a log ends too early; empty for a complete log


class Log(Protocol):
    """An open log, which may be damaged or malicious; it may be read several times."""

    @property
    def name(self) -> str:
        """The path, for error messages."""

    def topics(self) -> Mapping[str, str]:
        """Return name -> ROS type of all topics, such as sensor_msgs/msg/Image; '' where it cannot be decoded."""

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of messages of each topic; None where the log does not state it."""

    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last log time; None where the log does not state it, or is empty."""

    def image_spans_ns(self) -> Mapping[str, tuple[int, int]]:
        """Return the first and last log time of each topic of images that has some, as far as they can be read."""

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LoggedMessage]:
        """Yield the messages of these topics (None: all) in the order of log time; ends early after close."""

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; at most 32 of up to 16 MiB each, 64 MiB in all."""

    def damage(self) -> LogDamage:
        """Return the faults that are known: all of them once messages() has ended."""

    def close(self) -> None:
        """Close the files; may be called twice."""


class LogState(Enum):
    """State of a log; the values are shown to the user."""

    WHOLE = "whole"
    WRITTEN = "being written"
    UNINDEXED = "whole, but without an index"
    BROKEN = "cut or corrupt"


@dataclass(frozen=True, slots=True)
class LogInfo:
    """Contents of a log."""

    path: Path
    size_bytes: int
    state: LogState
    broken: int  # corrupt chunks and records; 0 where they were not examined
    fault: str  # one line that says what of the log is missing; empty for a complete log
    topics: Mapping[str, tuple[str, int]]  # topic -> type ('' where it cannot be decoded), number of messages
    span_ns: tuple[int, int] | None  # first and last log time; None without messages
    attachments: Mapping[str, int]  # name -> bytes of the readable ones, up to 32

    @property
    def messages(self) -> int:
        """Number of messages of all topics."""
        return sum(count for _, count in self.topics.values())


def widened(span_ns: tuple[int, int] | None, time_ns: int) -> tuple[int, int]:
    """Return the first and last time of a span (None: an empty one) and of one more time."""
    first_ns, last_ns = span_ns or (time_ns, time_ns)
    return min(first_ns, time_ns), max(last_ns, time_ns)


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
