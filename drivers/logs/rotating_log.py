"""A recording that goes on for as long as there is room, file after file, and never stops what is recorded."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Literal

from drivers.errors import DriverError
from drivers.events import EventCallback, ignore_event
from drivers.logs.log_folder import LogFolder, RotationSettings, complete_path, delete_file
from drivers.logs.mcap_writer import LogWriter

_FIRST_RETRY_S: Final = 1.0
_LAST_STAMP_NS: Final = 2**63


@dataclass(slots=True)
class RotatingLogState:
    """How a recording is; its writing thread alone writes, any thread may read one entry at a time."""

    status: Literal["waiting", "recording", "stopped", "closed"] = "waiting"
    file: str = ""  # being written
    problem: str = ""  # why it is stopped
    messages: int = 0  # handed over
    lost: int = 0  # of these, not in any file, for want of a disk
    refused: int = 0  # of these, that are no messages: of an unknown type, or without a time
    files: int = 0  # begun
    deleted: int = 0  # the oldest ones
    stops: int = 0


class RotatingLog:
    """Writes messages to MCAP files of limited size and age, each with the attachments; see log_folder for their names.

    It never raises: on a full or failing disk, or without its folder, it stops, says so once by `report`, counts what
    is lost, tries again with growing waits, and says when it goes on. For one thread; `state` may be read from any.
    """

    def __init__(
        self, folder: LogFolder, rotation: RotationSettings, attachments: Mapping[str, bytes],
        *, on_event: EventCallback = ignore_event,
    ) -> None:  # fmt: skip
        self.state = RotatingLogState()
        self._folder, self._rotation, self._attachments, self._on_event = folder, rotation, attachments, on_event
        self._writer: LogWriter | None = None
        self._path = folder.path
        self._number = 1
        self._start_ns = 0
        self._synced_s = self._retry_at_s = 0.0
        self._retry_s = _FIRST_RETRY_S
        self._lost_before = 0  # when it stopped

    def write(self, topic: str, schema_name: str, data: bytes | memoryview, stamp_ns: int) -> None:
        """Adds a message, CDR with its encapsulation header, at its stamp [ns of Unix time]."""
        self.state.messages += 1
        if not 0 <= stamp_ns < _LAST_STAMP_NS:
            self._refuse(f"{topic!r}: its stamp {stamp_ns} ns is not a time")
            return
        writer = self._current(stamp_ns)
        if writer is None:
            self.state.lost += 1
            return
        try:
            writer.write(topic, schema_name, data, stamp_ns)
            self._tend(writer)
        except DriverError as error:
            self._stop(error) if not writer.usable else self._refuse(str(error))

    def close(self) -> None:
        """Makes the file whole; nothing is recorded any more."""
        self._end()
        self.state.status, self._retry_at_s = "closed", float("inf")

    def _current(self, stamp_ns: int) -> LogWriter | None:
        """The file for a message of the stamp, if there can be one."""
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
        """A new file under a name of its own, which nobody else can take in the meantime."""
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
            delete_file(path)  # another program has made and ended its own between our look and the creation
            _drop(writer)

    def _refuse(self, reason: str) -> None:
        self.state.refused += 1
        if self.state.refused == 1:
            self._on_event(logging.WARNING, f"recording: refused a message, and counts others: {reason}")

    def _stop(self, error: DriverError) -> None:
        """Lets go of the file at hand; what of it has reached the disk stays for `omnid log recover`."""
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

    def _go_on(self) -> None:
        """There is a file again, and it takes what is written."""
        lost = self.state.lost - self._lost_before
        self.state.status, self.state.problem, self._retry_s = "recording", "", _FIRST_RETRY_S
        self._on_event(logging.INFO, f"recording: goes on in {str(self._path)!r}; {lost} messages were lost")

    def _tend(self, writer: LogWriter) -> None:
        """Brings the file to the disk now and then, and looks whether there is still room."""
        if self.state.status == "stopped" and writer.persisted:
            self._go_on()
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
        """Makes the file whole and gives it the name of one."""
        writer = self._writer
        if writer is None:
            return
        try:
            writer.close()
            self._name_whole()
        except DriverError as error:
            self._stop(error)
        self._writer, self.state.file = None, ""

    def _name_whole(self) -> None:
        try:
            self._path.rename(complete_path(self._path))
        except OSError as error:
            raise DriverError(f"cannot rename the log {str(self._path)!r}: {error.strerror}; is its folder gone?"
                              ) from error


def _drop(writer: LogWriter) -> None:
    """Closes a file that is given up."""
    with suppress(DriverError):
        writer.close()
