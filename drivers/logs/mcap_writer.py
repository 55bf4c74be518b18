"""Writes logs that ROS 2, Foxglove, Rerun and evo can read: MCAP, profile ros2, CDR messages."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO

from mcap.exceptions import McapError
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores

from drivers.errors import DriverError
from drivers.logs.log import LATEST_NS
from drivers.logs.ros_messages import typestore

_FOREVER = "\n    sec: 9223372036\n    nsec: 854775807\n"
# rosbag2's YAML of a topic that is kept for late subscribers: last one, reliable, transient local, automatic liveliness
_TRANSIENT_LOCAL = (
    f"- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:{_FOREVER}  lifespan:{_FOREVER}"
    f"  liveliness: 1\n  liveliness_lease_duration:{_FOREVER}  avoid_ros_namespace_conventions: false\n"
)
_FLUSH_NS = 5 * 10**8  # A chunk ends after this time, by the stamps.


class LogWriter:
    """Writes a log; a crash loses at most the last chunk, or half a second of stamps.

    attachments (name -> bytes) are written first, so that they survive a crash. JPEG images are not made smaller by a
    compression. An existing file is replaced, unless exclusive. The file is locked until it is closed.
    Raises DriverError where the file cannot be created or written (a full disk).

    messages: number of messages written; persisted: number of those that would survive a crash now; size_bytes: of the
    file without the current chunk.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        attachments: Mapping[str, bytes] | None = None,
        *,
        compression: CompressionType = CompressionType.LZ4,
        exclusive: bool = False,
    ) -> None:
        self._path = Path(path)
        self.messages = self.persisted = self.size_bytes = 0
        self._channels: dict[tuple[str, str], int] = {}
        try:
            self._file = self._path.open("xb" if exclusive else "wb")
        except OSError as error:
            raise DriverError(
                f"cannot create the log {str(self._path)!r}: {error.strerror}; give a path that can be written"
            ) from error
        lock(self._file)
        self.usable, self._flushed_ns = True, -1  # usable: until it is closed or fails
        try:
            with self._guarded():
                self._writer = Writer(self._file, compression=compression)
                self._writer.start("ros2", "omnid")
                for name, data in (attachments or {}).items():
                    self._writer.add_attachment(0, 0, name, "application/octet-stream", data)
                self._note_persisted()
        except DriverError:
            self._path.unlink(missing_ok=True)
            raise

    def write(self, topic: str, schema_name: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write a message: CDR with its encapsulation header, of a type such as nav_msgs/msg/Odometry.

        stamp_ns: log time [ns of Unix time]. Raises DriverError for an invalid stamp, or where the file cannot be
        written.
        """
        if not 0 <= stamp_ns < LATEST_NS:
            raise DriverError(f"cannot log a message on {topic!r}: its stamp {stamp_ns} ns is not a time")
        with self._guarded():
            channel = self._channel(topic, schema_name)
            self.messages += 1
            self._writer.add_message(channel, stamp_ns, bytes(data), stamp_ns)
            # A chunk that has ended is passed to the kernel at once.
            self._flushed_ns = stamp_ns if self._flushed_ns < 0 else self._flushed_ns
            if abs(stamp_ns - self._flushed_ns) >= _FLUSH_NS:
                self._flushed_ns = stamp_ns
                self._writer.flush()  # type: ignore[no-untyped-call]
            if self._file.tell() != self.size_bytes:
                self._note_persisted()

    def sync(self) -> None:
        """End the chunk and write all data to the disk; raise DriverError where that fails, or the file is gone."""
        with self._guarded():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._note_persisted()
            os.fsync(self._file.fileno())
            os.stat(self._path)  # it may have been deleted

    def close(self) -> None:
        """Write the index, which completes the file, and all data to the disk; may be called twice.

        Raises DriverError where that fails.
        """
        try:
            if self.usable:
                self.sync()
                with self._guarded():
                    self._writer.finish()  # type: ignore[no-untyped-call]
                    self._file.flush()
                    os.fsync(self._file.fileno())
        finally:
            self._abandon()

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
            schema = self._writer.register_schema(schema_name, "ros2msg", _schema_text(schema_name).encode())
            metadata = {"offered_qos_profiles": _TRANSIENT_LOCAL if topic == "/tf_static" else ""}
            self._channels[topic, schema_name] = self._writer.register_channel(topic, "cdr", schema, metadata)
        return self._channels[topic, schema_name]

    def _note_persisted(self) -> None:
        self._file.flush()
        self.size_bytes, self.persisted = self._file.tell(), self.messages


@cache
def _schema_text(schema_name: str) -> str:
    """Return the definition of a ROS 2 type and of all its parts."""
    return typestore(Stores.ROS2_HUMBLE).generate_msgdef(schema_name, ros_version=2)[0]


# Advisory locks that mark a file as being written; the kernel releases them when the program ends.


def lock(file: IO[bytes]) -> None:
    """Mark an open file as being written until it is closed; without effect where the file system has no locks."""
    with suppress(OSError):
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_locked(path: str | os.PathLike[str]) -> bool:
    """True if a program, this one included, is writing the file; False where it cannot be opened."""
    try:
        if Path(path).is_file():
            with open(path, "rb") as file:
                fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    return False
