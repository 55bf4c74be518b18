"""A recording in several files, which continues while the disk has space and never stops the program."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Literal

from drivers.errors import DriverError
from drivers.events import EventCallback
from drivers.logs.log_folder import LogFolder, RotationSettings, complete_path, delete_file
from drivers.logs.mcap_writer import LogWriter

_FIRST_RETRY_S: Final = 1.0
_END_NS: Final = 2**63  # Valid stamps are smaller.


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
    """Writes messages to MCAP files of limited size and age, each with the attachments; see log_folder for their names.

    It never raises: on a full or failing disk, or without its folder, it stops, reports that once by `on_event`,
    counts lost messages, tries again with growing waits, and reports when it continues. For one thread; `state` may
    be read from any.
    """

    def __init__(
        self, folder: LogFolder, rotation: RotationSettings, attachments: Mapping[str, bytes],
        *, on_event: EventCallback,
    ) -> None:  # fmt: skip
        self.state = RotatingLogState()
        self._folder, self._rotation, self._on_event = folder, rotation, on_event
        self._attachments = dict(attachments)
        self._writer: LogWriter | None = None
        self._path = folder.path
        self._number = 1
        self._start_ns = 0
        self._synced_s = self._retry_at_s = 0.0
        self._retry_s = _FIRST_RETRY_S
        self._lost_before = 0  # lost messages when it stopped

    def write(self, topic: str, schema_name: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Write a message, CDR with its encapsulation header, at its stamp [ns of Unix time]."""
        self.state.messages += 1
        if not 0 <= stamp_ns < _END_NS:
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

    def close(self) -> None:
        """Complete the file and end the recording."""
        self._end()
        self.state.status, self._retry_at_s = "closed", float("inf")

    def _current(self, stamp_ns: int) -> LogWriter | None:
        """Return the file for a message with this stamp, None where none can be created."""
        if self._writer is not None and self._is_full(self._writer, stamp_ns):
            self._end()
        if self._writer is None and time.monotonic() >= self._retry_at_s:
            self._begin(stamp_ns)
        return self._writer

    def _is_full(self, writer: LogWriter, stamp_ns: int) -> bool:
        age_s = abs(stamp_ns - self._start_ns) / 1e9
        return writer.size_bytes >= self._rotation.file_bytes or age_s >= self._rotation.file_s

    def _begin(self, stamp_ns: int) -> None:
        keep = self._rotation
        self.state.deleted += self._folder.delete_oldest(keep.keep_files - 1, keep.keep_bytes - keep.file_bytes)
        try:
            self._folder.require_free_space(keep.free_bytes + keep.file_bytes)
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
        """Create a file with an unused name, which no other program uses."""
        while True:
            path, number = self._folder.unused_path(stamp_ns, self._number)
            self._number, self._path = number + 1, path
            try:
                writer = LogWriter(path, self._attachments, compression="none", exclusive=True)
            except DriverError as error:
                if isinstance(error.__cause__, FileExistsError):
                    continue
                delete_file(path)
                raise
            if not os.path.lexists(complete_path(path)):
                return writer
            delete_file(path)  # another program has completed a file of this name since the check
            _drop(writer)

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
            _drop(writer)
            if not writer.persisted:
                delete_file(self._path)
        self.state.problem, self.state.file = str(error), ""
        self._retry_at_s = time.monotonic() + self._retry_s
        self._retry_s = min(2 * self._retry_s, self._rotation.retry_s)

    def _resume(self) -> None:
        """Report that a new file is being written."""
        lost = self.state.lost - self._lost_before
        self.state.status, self.state.problem, self._retry_s = "recording", "", _FIRST_RETRY_S
        self._on_event(logging.INFO, f"recording: continues in {str(self._path)!r}; {lost} messages were lost")

    def _maintain(self, writer: LogWriter) -> None:
        """Write the file to the disk once per sync_s, and check the free space."""
        if self.state.status == "stopped" and writer.persisted:
            self._resume()
        if time.monotonic() - self._synced_s < self._rotation.sync_s:
            return
        writer.sync()
        self._synced_s = time.monotonic()
        try:
            self._folder.require_free_space(self._rotation.free_bytes)
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
            self._rename()
        except DriverError as error:
            self._stop(error)
        self._writer, self.state.file = None, ""

    def _rename(self) -> None:
        try:
            self._path.rename(complete_path(self._path))
        except OSError as error:
            raise DriverError(
                f"cannot rename the log {str(self._path)!r}: {error.strerror}; is its folder gone?"
            ) from error


def _drop(writer: LogWriter) -> None:
    """Close a file without reporting failures."""
    with suppress(DriverError):
        writer.close()
