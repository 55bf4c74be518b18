"""A folder of recordings: what its files are called, how many are kept and how much room is left on the disk.

    <name>_20260131T235900Z_001.mcap.part   is being written, or was when its program died: see `omnid log recover`
    <name>_20260131T235900Z_001.mcap        is whole

The time is that of the first message, UTC; the number counts the files of one run and those of the same second. Only
files with such names are ever deleted. Several programs may share a folder: what one of them writes is locked.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from drivers.errors import DriverError
from drivers.logs.file_lock import is_locked

PART_SUFFIX: Final = ".part"
_MAX_NUMBER: Final = 999_999
_MB: Final = 10**6


@dataclass(frozen=True, slots=True)
class RotationSettings:
    """When a new file is begun, and what is kept of the old ones."""

    file_bytes: int = 500 * _MB  # a new file after so much
    file_s: float = 600.0  # or so long, by the stamps
    keep_files: int = 1000  # the oldest are deleted
    keep_bytes: int = 20_000 * _MB  # of all files, the one being written in its full size among them
    free_bytes: int = 1000 * _MB  # left to others: with less on the disk nothing is recorded
    sync_s: float = 3.0  # the disk is made to write this often
    retry_s: float = 30.0  # longest wait between two tries on a disk that failed


class RecordingFile(NamedTuple):
    """A file of the folder."""

    time: str
    number: int
    path: Path
    size: int  # bytes


class LogFolder:
    """The recordings of one name in a folder, which is made where its parent is there; faults are DriverError."""

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self._name = re.sub(r"[^\w.-]", "-", name)
        self._pattern = re.compile(re.escape(self._name) + r"_(\d{8}T\d{6}Z)_(\d{3,6})\.mcap(?:\.part)?")

    def unused_path(self, stamp_ns: int, number: int) -> tuple[Path, int]:
        """A path for a file that starts at the stamp, and the number that it got, from `number` on."""
        at = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(stamp_ns // 10**9))
        for n in range(number, _MAX_NUMBER):
            whole = self.path / f"{self._name}_{at}_{n:03}.mcap"
            part = Path(f"{whole}{PART_SUFFIX}")
            if not (os.path.lexists(whole) or os.path.lexists(part)):
                return part, n
        raise DriverError(f"cannot record to {str(self.path)!r}: all numbers are taken; name another folder")

    def delete_oldest(self, files: int, size: int) -> int:
        """Deletes the oldest recordings until at most so many files and bytes are left; how many that were.

        What is being written stays, and what cannot be deleted.
        """
        found = sorted(self._recordings())
        total, deleted = sum(recording.size for recording in found), 0
        for recording in found:
            if len(found) - deleted <= files and total <= size:
                break
            if not is_locked(recording.path) and delete_file(recording.path):
                total -= recording.size
                deleted += 1
        return deleted

    def require_free_space(self, wanted_bytes: int) -> None:
        """DriverError where the disk has less; makes the folder."""
        try:
            with suppress(FileExistsError):
                self.path.mkdir()
            disk = os.statvfs(self.path)
        except OSError as error:
            raise DriverError(f"cannot record to {str(self.path)!r}: {error.strerror}; name another folder") from error
        free = disk.f_bavail * disk.f_frsize
        if free < wanted_bytes:
            raise DriverError(f"cannot record to {str(self.path)!r}: {free // _MB} MB are free and "
                              f"{-(-wanted_bytes // _MB)} wanted; make room, or keep fewer or smaller files")

    def _recordings(self) -> Iterator[RecordingFile]:
        with suppress(OSError), os.scandir(self.path) as entries:
            for entry in entries:
                found = self._pattern.fullmatch(entry.name)
                if found and entry.is_file(follow_symlinks=False):
                    with suppress(OSError):  # another program may have deleted it
                        yield RecordingFile(found[1], int(found[2]), Path(entry.path), entry.stat().st_size)


def delete_file(path: Path) -> bool:
    """Deletes a file; whether that went well."""
    with suppress(OSError):
        path.unlink()
        return True
    return False


def complete_path(path: Path) -> Path:
    """The name of a file once it is whole."""
    return path.with_name(path.name.removesuffix(PART_SUFFIX))
