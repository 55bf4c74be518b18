"""Writes logs that ROS 2, Foxglove, Rerun and evo can read: MCAP, profile ros2, CDR messages; one file, or several.

Several files continue while the disk has space, and never stop the program. They are <name>_20260131T235900Z_001.mcap:
the time is that of the first message, UTC; the number counts the files of one run and those of the same second. No
files with other names are deleted. A file that was left by a program that crashed is readable up to its end.
"""

from __future__ import annotations

import logging
import math
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Literal

from mcap.exceptions import McapError
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores

from drivers.backoff import Backoff
from drivers.errors import DriverError, EventCallback
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
    compression. An existing file is replaced.
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
    ) -> None:
        self._path = Path(path)
        self.messages = self.persisted = self.size_bytes = 0
        self._channels: dict[tuple[str, str], int] = {}
        try:
            self._file = self._path.open("wb")
        except OSError as error:
            raise DriverError(
                f"cannot create the log {str(self._path)!r}: {error.strerror}; give a path that can be written"
            ) from error
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
            text = typestore(Stores.ROS2_HUMBLE).generate_msgdef(schema_name, ros_version=2)[0]  # with all its parts
            schema = self._writer.register_schema(schema_name, "ros2msg", text.encode())
            metadata = {"offered_qos_profiles": _TRANSIENT_LOCAL if topic == "/tf_static" else ""}
            self._channels[topic, schema_name] = self._writer.register_channel(topic, "cdr", schema, metadata)
        return self._channels[topic, schema_name]

    def _note_persisted(self) -> None:
        self._file.flush()
        self.size_bytes, self.persisted = self._file.tell(), self.messages


@dataclass(frozen=True, slots=True)
class RotationSettings:
    """Limits at which a new file is started, and limits of the files kept."""

    file_bytes: int  # size at which a new file is started
    keep_bytes: int  # of all files, including the one being written at its full size
    free_bytes: int  # reserved on the disk: with less free space nothing is recorded
    file_s: float = 600.0  # age at which a new file is started, by the stamps
    sync_s: float = 3.0  # period of writing to the disk (fsync)


@dataclass(slots=True)
class RotatingLogState:
    """Status and counters; only the writing thread writes them, any thread may read one field at a time."""

    status: Literal["recording", "stopped", "closed"] = "recording"
    problem: str = ""  # reason for the status "stopped"
    messages: int = 0  # received
    lost: int = 0  # of these, in no file: the disk failed or was full, or they are not valid
    files: int = 0  # created
    deleted: int = 0  # oldest files


class RotatingLog:
    """Writes messages to MCAP files of limited size and age in a folder, each with the attachments.

    The folder is made if its parent exists. It never raises: on a full or failing disk, or without its folder, it
    stops, reports that once by `on_event`, counts lost messages, tries again, and reports when it continues. For one
    thread; `state` may be read from any.
    """

    def __init__(
        self, folder: Path, name: str, rotation: RotationSettings, attachments: Mapping[str, bytes],
        *, on_event: EventCallback,
    ) -> None:  # fmt: skip
        """name: of the files; characters that could lead out of the folder are replaced."""
        self.state = RotatingLogState()
        self._folder, self._rotation, self._on_event = folder, rotation, on_event
        self._name, self._attachments = re.sub(r"[^\w.-]", "-", name), dict(attachments)
        self._writer: LogWriter | None = None
        self._path = folder
        self._own: dict[str, int] = {}  # number in this run of its files: the clock may be set back meanwhile
        self._start_ns = 0  # first stamp of the file
        self._synced_s = self._retry_at_s = 0.0
        self._waits = Backoff()

    def write(self, topic: str, schema_name: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write a message, CDR with its encapsulation header, at its stamp [ns of Unix time]."""
        self.state.messages += 1
        keep, age_s = self._rotation, abs(stamp_ns - self._start_ns) / 1e9
        if self._writer is not None and (self._writer.size_bytes >= keep.file_bytes or age_s >= keep.file_s):
            self.end_file()
        if self._writer is None and time.monotonic() < self._retry_at_s:
            self.state.lost += 1
            return
        try:
            # 1. The file, and the message.
            writer = self._writer or self._new_file(stamp_ns)
            writer.write(topic, schema_name, data, stamp_ns)
            if self.state.status == "stopped" and writer.persisted:
                self.state.status, self.state.problem = "recording", ""
                self._waits.reset()
                self._on_event(logging.INFO, f"recording: continues in {str(self._path)!r}; lost: {self.state.lost}")
            # 2. The disk.
            if time.monotonic() - self._synced_s >= keep.sync_s:
                self._synced_s = time.monotonic()
                writer.sync()
                self._require_free_space(keep.free_bytes)
        except DriverError as error:
            self.state.lost += self._writer is None
            self._stop(error)

    def end_file(self) -> None:
        """Complete the file, if there is one: the next message begins another one."""
        if self._writer is not None:
            try:
                self._writer.close()
            except DriverError as error:
                self._stop(error)
        self._writer = None

    def close(self) -> None:
        """Complete the file and end the recording."""
        self.end_file()
        self.state.status, self._retry_at_s = "closed", math.inf

    def _new_file(self, stamp_ns: int) -> LogWriter:
        """Create a file with the next number that no other program uses; raise DriverError where that is impossible."""
        self._delete_oldest()
        self._require_free_space(self._rotation.free_bytes + self._rotation.file_bytes)
        at = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(stamp_ns // 10**9))
        names = (f"{self._name}_{at}_{number:03}.mcap" for number in count(1 + self.state.files))
        self._path = next(path for name in names if not os.path.lexists(path := self._folder / name))
        self._writer = LogWriter(self._path, self._attachments, compression=CompressionType.NONE)
        self._start_ns, self._synced_s = stamp_ns, time.monotonic()
        self.state.files += 1
        self._own[self._path.name] = self.state.files
        return self._writer

    def _stop(self, error: Exception) -> None:
        """Close the file; its data on the disk is kept."""
        if self.state.status != "stopped":
            self.state.status = "stopped"
            self._on_event(logging.WARNING, f"recording: stopped, and tried again until it works: {error}")
        writer, self._writer = self._writer, None
        if writer is not None:
            with suppress(DriverError):  # which has been reported
                writer.close()
            self.state.lost += writer.messages - writer.persisted
            if not writer.persisted:
                self.state.files -= 1
                self._path.unlink(missing_ok=True)
        self.state.problem, self._retry_at_s = str(error), time.monotonic() + self._waits.next_s()

    def _delete_oldest(self) -> None:
        """Delete the oldest recordings of this name until there is room for one more within the limit.

        Files that cannot be deleted are kept, and links are none.
        """
        pattern = re.compile(re.escape(self._name) + r"_\d{8}T\d{6}Z_\d{3,}\.mcap")
        with suppress(OSError):
            names = [name for name in os.listdir(self._folder) if pattern.fullmatch(name)]
            names.sort(key=lambda name: (self._own.get(name, 0), name))
            sizes = {p: p.stat().st_size for name in names if not os.path.islink(p := self._folder / name)}
            for path in [*sizes]:
                if sum(sizes.values()) <= self._rotation.keep_bytes - self._rotation.file_bytes:
                    break
                path.unlink()
                del sizes[path]
                self.state.deleted += 1

    def _require_free_space(self, wanted_bytes: int) -> None:
        """Create the folder; raise DriverError where it cannot be created, or the disk has less free space."""
        try:
            self._folder.mkdir(exist_ok=True)
            disk = os.statvfs(self._folder)
        except OSError as error:
            raise DriverError(
                f"cannot record to {str(self._folder)!r}: {error.strerror}; name another folder"
            ) from error
        free = disk.f_bavail * disk.f_frsize
        if free < wanted_bytes:
            raise DriverError(
                f"cannot record to {str(self._folder)!r}: {free / 1e6:.0f} MB are free and "
                f"{wanted_bytes / 1e6:.0f} needed; make room, or keep fewer or smaller files"
            )
