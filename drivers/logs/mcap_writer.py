"""Writes logs that ROS 2, Foxglove, Rerun and evo can read: MCAP, profile ros2, CDR messages."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO, Literal, Self

from mcap.exceptions import McapError
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores

from drivers.errors import DriverError
from drivers.logs.log import LATEST_NS
from drivers.logs.ros_messages import typestore

_COMPRESSIONS = {"lz4": CompressionType.LZ4, "none": CompressionType.NONE}
_KEPT_TOPICS = ("/tf_static",)  # ROS 2 keeps their newest message for late subscribers, also of `ros2 bag play`
_FOREVER = "\n    sec: 9223372036\n    nsec: 854775807\n"
# rosbag2's YAML: keep last, reliable, transient local, automatic liveliness
_TRANSIENT_LOCAL = (
    f"- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:{_FOREVER}  lifespan:{_FOREVER}"
    f"  liveliness: 1\n  liveliness_lease_duration:{_FOREVER}  avoid_ros_namespace_conventions: false\n"
)
_FLUSH_NS = 5 * 10**8  # A chunk ends after this time, by the stamps.


class LogWriter:
    """Writes a log; a crash loses at most the last chunk, or half a second of stamps.

    attachments (name -> bytes) are written first, so that they survive a crash. compression: lz4 or none; JPEG images
    are not made smaller by it. An existing file is replaced, unless exclusive. The file is locked until it is closed.
    Raises DriverError where the file cannot be created or written (a full disk), and for a message type that ROS 2
    does not have.

    messages: number of messages written; persisted: number of those that would survive a crash now; size_bytes: of the
    file without the current chunk.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        attachments: Mapping[str, bytes] | None = None,
        chunk_bytes: int = 256 * 1024,
        *,
        compression: Literal["lz4", "none"] = "lz4",
        exclusive: bool = False,
    ) -> None:
        self._path = Path(path)
        self.messages = self.persisted = self.size_bytes = 0
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        try:
            self._file = self._path.open("xb" if exclusive else "wb")
        except OSError as error:
            raise DriverError(
                f"cannot create the log {str(self._path)!r}: {error.strerror}; give a path that can be written"
            ) from error
        lock(self._file)
        self.usable, self._flushed_ns = True, -1  # usable: until it is closed or fails
        with self._guarded():
            self._writer = Writer(self._file, chunk_bytes, _COMPRESSIONS[compression])
            self._writer.start("ros2", "omnid")
            for name, data in (attachments or {}).items():
                self._writer.add_attachment(0, 0, name, "application/octet-stream", data)
            self._note_persisted()

    def write(self, topic: str, schema_name: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write a message: CDR with its encapsulation header, of a type such as nav_msgs/msg/Odometry.

        stamp_ns: log time [ns of Unix time]. Raises DriverError for an unknown type, an invalid stamp, or where the
        file cannot be written.
        """
        if not 0 <= stamp_ns < LATEST_NS:
            raise DriverError(f"cannot log a message on {topic!r}: its stamp {stamp_ns} ns is not a time")
        with self._guarded():
            channel = self._channel(topic, schema_name)
            self.messages += 1
            self._writer.add_message(channel, stamp_ns, bytes(data), stamp_ns)
            # A chunk ends after half a second of stamps; one that has ended is passed to the kernel at once.
            self._flushed_ns = stamp_ns if self._flushed_ns < 0 else self._flushed_ns
            if abs(stamp_ns - self._flushed_ns) >= _FLUSH_NS:
                self._flushed_ns = stamp_ns
                self._flush()
            elif self._file.tell() != self.size_bytes:
                self._note_persisted()

    def sync(self) -> None:
        """End the chunk and write all data to the disk; raise DriverError where that fails or the file was deleted."""
        with self._guarded():
            self._flush()
            self._reach_disk()

    def close(self) -> None:
        """Write the index, which completes the file, and all data to the disk; may be called twice.

        Raises DriverError where that fails or the file was deleted.
        """
        try:
            if self.usable:
                with self._guarded():
                    self._flush()
                    self._writer.finish()  # type: ignore[no-untyped-call]
                    self._file.flush()
                    self._reach_disk()
        finally:
            self._abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turn a failure to write into DriverError and close the file, which can be read up to its end."""
        if not self.usable:
            raise DriverError(f"cannot write the log {str(self._path)!r}: it is closed or failed before")
        try:
            yield
        except (OSError, McapError) as error:
            self._abandon()
            reason = getattr(error, "strerror", None) or " ".join(str(error).split())
            raise DriverError(
                f"cannot write the log {str(self._path)!r}: {reason}; free the disk or log elsewhere"
            ) from error

    def _abandon(self) -> None:
        """Close the file; a failure to flush has been reported before."""
        self.usable = False
        with suppress(OSError):
            self._file.close()

    def _channel(self, topic: str, schema_name: str) -> int:
        """Return the channel of a topic and a type."""
        if (topic, schema_name) not in self._channels:
            if schema_name not in self._schemas:
                text = schema_text(schema_name).encode()
                self._schemas[schema_name] = self._writer.register_schema(schema_name, "ros2msg", text)
            metadata = {"offered_qos_profiles": _TRANSIENT_LOCAL if topic in _KEPT_TOPICS else ""}
            channel = self._writer.register_channel(topic, "cdr", self._schemas[schema_name], metadata)
            self._channels[topic, schema_name] = channel
        return self._channels[topic, schema_name]

    def _flush(self) -> None:
        """End the chunk and pass it to the kernel."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._note_persisted()

    def _note_persisted(self) -> None:
        self._file.flush()
        self.size_bytes, self.persisted = self._file.tell(), self.messages

    def _reach_disk(self) -> None:
        os.fsync(self._file.fileno())
        if os.fstat(self._file.fileno()).st_nlink == 0:
            self.persisted = 0
            raise FileNotFoundError(errno.ENOENT, "the file has been deleted")


@cache
def schema_text(schema_name: str) -> str:
    """Return the definition of a ROS 2 type and of all its parts; raise DriverError for an unknown type."""
    store = typestore(Stores.ROS2_HUMBLE)
    if schema_name not in store.fielddefs:
        raise DriverError(f"unknown message type {schema_name!r}: give a type of ROS 2, such as nav_msgs/msg/Odometry")
    return store.generate_msgdef(schema_name, ros_version=2)[0]


# Advisory locks that mark a file as being written; the kernel releases them when the program ends.


def lock(file: IO[bytes]) -> None:
    """Mark an open file as being written until it is closed; without effect where the file system has no locks."""
    with suppress(OSError):
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_locked(path: str | os.PathLike[str]) -> bool:
    """True if a program, this one included, is writing the file; False where it cannot be opened."""
    if not Path(path).is_file():
        return False
    try:
        with open(path, "rb") as file:
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
