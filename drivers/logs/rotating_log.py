"""A recording in several files, which continues while the disk has space and never stops the program.

    <name>_20260131T235900Z_001.mcap.part   being written, or left by a program that crashed: readable up to its end
    <name>_20260131T235900Z_001.mcap        complete

The time is that of the first message, UTC; the number counts the files of one run and those of the same second. No
files with other names are deleted. Several programs may share a folder: a file being written is locked.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from drivers.backoff import Backoff
from drivers.errors import DriverError
from drivers.events import EventCallback
from drivers.logs.file_lock import is_locked
from drivers.logs.log import LATEST_NS
from drivers.logs.mcap_writer import LogWriter

_PART: Final = ".part"
_MB: Final = 10**6


@dataclass(frozen=True, slots=True)
class RotationSettings:
    """Limits at which a new file is started, and limits of the files kept."""

    file_bytes: int = 500 * _MB  # size at which a new file is started
    file_s: float = 600.0  # age at which a new file is started, by the stamps
    keep_files: int = 1000  # the oldest are deleted
    keep_bytes: int = 20_000 * _MB  # of all files, including the one being written at its full size
    free_bytes: int = 1000 * _MB  # reserved on the disk: with less free space nothing is recorded
    sync_s: float = 3.0  # period of writing to the disk (fsync)
    retry_s: float = 30.0  # longest wait between two tries after a failure of the disk


@dataclass(slots=True)
class RotatingLogState:
    """Status and counters; only the writing thread writes them, any thread may read one field at a time."""

    status: Literal["waiting", "recording", "stopped", "closed"] = "waiting"
    file: str = ""  # being written
    problem: str = ""  # reason for the status "stopped"
    messages: int = 0  # received
    lost: int = 0  # of these, in no file, since the disk failed or was full
    refused: int = 0  # of these, invalid: of an unknown type, or without a valid stamp
    files: int = 0  # created
    deleted: int = 0  # oldest files
    stops: int = 0  # transitions to the status "stopped"


class RotatingLog:
    """Writes messages to MCAP files of limited size and age in a folder, each with the attachments.

    The folder is made if its parent exists. It never raises: on a full or failing disk, or without its folder, it
    stops, reports that once by `on_event`, counts lost messages, tries again with growing waits, and reports when it
    continues. For one thread; `state` may be read from any.
    """

    def __init__(
        self, folder: Path, name: str, rotation: RotationSettings, attachments: Mapping[str, bytes],
        *, on_event: EventCallback,
    ) -> None:  # fmt: skip
        """name: of the files; characters that could lead out of the folder are replaced."""
        self.state = RotatingLogState()
        self._folder, self._rotation, self._on_event = folder, rotation, on_event
        self._name = re.sub(r"[^\w.-]", "-", name)
        self._attachments = dict(attachments)
        self._writer: LogWriter | None = None
        self._path = folder
        self._number = 0
        self._own: dict[str, int] = {}  # names of the files of this run, in their order
        self._start_ns = 0
        self._synced_s = self._retry_at_s = 0.0
        self._backoff = Backoff(rotation.retry_s)
        self._lost_before = 0  # lost messages when it stopped

    def write(self, topic: str, schema_name: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write a message, CDR with its encapsulation header, at its stamp [ns of Unix time]."""
        self.state.messages += 1
        if not 0 <= stamp_ns < LATEST_NS:
            self._refuse(f"{topic!r}: its stamp {stamp_ns} ns is not a time")
            return
        writer = self._current(stamp_ns)
        if writer is None:
            self.state.lost += 1
            return
        try:
            writer.write(topic, schema_name, data, stamp_ns)
            self._maintain(writer)
        except DriverError as error:
            if writer.usable:
                self._refuse(str(error))
            else:
                self._stop(error)

    def end_file(self) -> None:
        """Complete the file: the next message begins another one."""
        self._end()

    def close(self) -> None:
        """Complete the file and end the recording."""
        self._end()
        self.state.status, self._retry_at_s = "closed", float("inf")

    def _current(self, stamp_ns: int) -> LogWriter | None:
        """Return the file for a message with this stamp, None where none can be created."""
        if self._writer is not None:
            age_s = abs(stamp_ns - self._start_ns) / 1e9
            if self._writer.size_bytes >= self._rotation.file_bytes or age_s >= self._rotation.file_s:
                self._end()
        if self._writer is None and time.monotonic() >= self._retry_at_s:
            self._begin(stamp_ns)
        return self._writer

    def _begin(self, stamp_ns: int) -> None:
        """Make room, then create a file; the recording stops where that fails."""
        keep = self._rotation
        self.state.deleted += self._delete_oldest(keep.keep_files - 1, keep.keep_bytes - keep.file_bytes)
        try:
            self._require_free_space(keep.free_bytes + keep.file_bytes)
            self._writer = self._created(stamp_ns)
        except DriverError as error:
            self._stop(error)
            return
        self._start_ns, self._synced_s = stamp_ns, time.monotonic()
        self.state.files += 1
        self.state.file = str(self._path)
        if self.state.status == "waiting":
            self.state.status = "recording"

    def _created(self, stamp_ns: int) -> LogWriter:
        """Create a file with the next number that no other program uses."""
        at = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(stamp_ns // 10**9))
        while True:
            self._number += 1
            self._path = self._folder / f"{self._name}_{at}_{self._number:03}.mcap{_PART}"
            if os.path.lexists(_complete(self._path)):
                continue
            try:
                writer = LogWriter(self._path, self._attachments, compression="none", exclusive=True)
            except DriverError as error:
                if isinstance(error.__cause__, FileExistsError):
                    continue
                _delete(self._path)
                raise
            self._own[_complete(self._path).name] = self._number
            return writer

    def _refuse(self, reason: str) -> None:
        self.state.refused += 1
        if self.state.refused == 1:
            self._on_event(logging.WARNING, f"recording: refused a message; further ones are counted: {reason}")

    def _stop(self, error: DriverError) -> None:
        """Close the file; its data on the disk is kept."""
        if self.state.status != "stopped":
            self.state.status, self._lost_before = "stopped", self.state.lost
            self.state.stops += 1
            self._on_event(logging.WARNING, f"recording: stopped, and tried again until it works: {error}")
        writer, self._writer = self._writer, None
        if writer is not None:
            self.state.lost += writer.messages - writer.persisted
            with suppress(DriverError):  # which has been reported
                writer.close()
            if not writer.persisted:
                _delete(self._path)
        self.state.problem, self.state.file = str(error), ""
        self._retry_at_s = time.monotonic() + self._backoff.next_s()

    def _maintain(self, writer: LogWriter) -> None:
        """Report that a recording continues; write the file to the disk once per sync_s, and check the free space."""
        if self.state.status == "stopped" and writer.persisted:
            self.state.status, self.state.problem = "recording", ""
            self._backoff.reset()
            lost = self.state.lost - self._lost_before
            self._on_event(logging.INFO, f"recording: continues in {str(self._path)!r}; {lost} messages were lost")
        if time.monotonic() - self._synced_s < self._rotation.sync_s:
            return
        writer.sync()
        self._synced_s = time.monotonic()
        try:
            self._require_free_space(self._rotation.free_bytes)
        except DriverError as error:
            self._end()
            self._stop(error)

    def _end(self) -> None:
        """Complete the file and rename it."""
        writer = self._writer
        if writer is None:
            return
        try:
            writer.close()
            self._path.rename(_complete(self._path))
        except DriverError as error:
            self._stop(error)
        except OSError as error:
            reason = f"{error.strerror}; is its folder gone?"
            self._stop(DriverError(f"cannot rename the log {str(self._path)!r}: {reason}"))
        self._writer, self.state.file = None, ""

    def _delete_oldest(self, max_files: int, max_bytes: int) -> int:
        """Delete the oldest recordings until the limits are met, and return the number of deleted files.

        Files that are being written, or cannot be deleted, are kept.
        """
        found = sorted(self._recordings())
        total_bytes, deleted = sum(size for *_, size in found), 0
        for *_, path, size in found:
            if len(found) - deleted <= max_files and total_bytes <= max_bytes:
                break
            if not is_locked(path) and _delete(path):
                total_bytes -= size
                deleted += 1
        return deleted

    def _recordings(self) -> Iterator[tuple[int, str, int, Path, int]]:
        """Yield place in this run, time, number, path and size [bytes] of the files with this name; they sort by age.

        Files of this run are the newest, in their order: the computer's clock may have been set back meanwhile.
        """
        pattern = re.compile(re.escape(self._name) + r"_(\d{8}T\d{6}Z)_(\d{3,})\.mcap(?:\.part)?")
        with suppress(OSError), os.scandir(self._folder) as entries:
            for entry in entries:
                found = pattern.fullmatch(entry.name)
                if found and entry.is_file(follow_symlinks=False):
                    path = Path(entry.path)
                    with suppress(OSError):  # another program may have deleted it
                        place = self._own.get(_complete(path).name, 0)
                        yield place, found[1], int(found[2]), path, entry.stat().st_size

    def _require_free_space(self, wanted_bytes: int) -> None:
        """Create the folder; raise DriverError where it cannot be created, or the disk has less free space."""
        try:
            with suppress(FileExistsError):
                self._folder.mkdir()
            disk = os.statvfs(self._folder)
        except OSError as error:
            raise DriverError(
                f"cannot record to {str(self._folder)!r}: {error.strerror}; name another folder"
            ) from error
        free = disk.f_bavail * disk.f_frsize
        if free < wanted_bytes:
            raise DriverError(
                f"cannot record to {str(self._folder)!r}: {free // _MB} MB are free and "
                f"{-(-wanted_bytes // _MB)} needed; make room, or keep fewer or smaller files"
            )


def _complete(part: Path) -> Path:
    """Return the path of a file after its completion."""
    return part.with_name(part.name.removesuffix(_PART))


def _delete(path: Path) -> bool:
    """Delete a file; False where that fails."""
    with suppress(OSError):
        path.unlink()
        return True
    return False
