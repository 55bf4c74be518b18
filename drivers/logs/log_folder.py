"""A folder of recordings: file names, number of files kept, and free space on the disk.

    <name>_20260131T235900Z_001.mcap.part   being written, or left by a program that crashed: readable up to its end
    <name>_20260131T235900Z_001.mcap        complete

The time is that of the first message, UTC; the number counts the files of one run and those of the same second. No
files with other names are deleted. Several programs may share a folder: a file being written is locked.
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
    """Limits at which a new file is started, and limits of the files kept."""

    file_bytes: int = 500 * _MB  # size at which a new file is started
    file_s: float = 600.0  # age at which a new file is started, by the stamps
    keep_files: int = 1000  # the oldest are deleted
    keep_bytes: int = 20_000 * _MB  # of all files, including the one being written at its full size
    free_bytes: int = 1000 * _MB  # reserved on the disk: with less free space nothing is recorded
    sync_s: float = 3.0  # period of writing to the disk (fsync)
    retry_s: float = 30.0  # longest wait between two tries after a failure of the disk


class RecordingFile(NamedTuple):
    """A file of the folder; sorts by age."""

    time: str  # UTC, as in the file name
    number: int
    path: Path
    size: int  # bytes


class LogFolder:
    """The recordings with one name in a folder, which is created if its parent exists."""

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self._name = re.sub(r"[^\w.-]", "-", name)
        self._pattern = re.compile(re.escape(self._name) + r"_(\d{8}T\d{6}Z)_(\d{3,6})\.mcap(?:\.part)?")

    def unused_path(self, stamp_ns: int, number: int) -> tuple[Path, int]:
        """Return an unused path for a file that starts at the stamp, and its number, which is at least `number`.

        Raises DriverError where all numbers are used.
        """
        at = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(stamp_ns // 10**9))
        for n in range(number, _MAX_NUMBER):
            whole = self.path / f"{self._name}_{at}_{n:03}.mcap"
            part = Path(f"{whole}{PART_SUFFIX}")
            if not (os.path.lexists(whole) or os.path.lexists(part)):
                return part, n
        raise DriverError(f"cannot record to {str(self.path)!r}: all file numbers are used; name another folder")

    def delete_oldest(self, max_files: int, max_bytes: int) -> int:
        """Delete the oldest recordings until the limits are met, and return the number of deleted files.

        Files that are being written, or cannot be deleted, are kept.
        """
        found = sorted(self._recordings())
        total_bytes, deleted = sum(recording.size for recording in found), 0
        for recording in found:
            if len(found) - deleted <= max_files and total_bytes <= max_bytes:
                break
            if not is_locked(recording.path) and delete_file(recording.path):
                total_bytes -= recording.size
                deleted += 1
        return deleted

    def require_free_space(self, wanted_bytes: int) -> None:
        """Create the folder; raise DriverError where it cannot be created, or the disk has less free space."""
        try:
            with suppress(FileExistsError):
                self.path.mkdir()
            disk = os.statvfs(self.path)
        except OSError as error:
            raise DriverError(f"cannot record to {str(self.path)!r}: {error.strerror}; name another folder") from error
        free = disk.f_bavail * disk.f_frsize
        if free < wanted_bytes:
            raise DriverError(
                f"cannot record to {str(self.path)!r}: {free // _MB} MB are free and "
                f"{-(-wanted_bytes // _MB)} needed; make room, or keep fewer or smaller files"
            )

    def _recordings(self) -> Iterator[RecordingFile]:
        with suppress(OSError), os.scandir(self.path) as entries:
            for entry in entries:
                found = self._pattern.fullmatch(entry.name)
                if found and entry.is_file(follow_symlinks=False):
                    with suppress(OSError):  # another program may have deleted it
                        yield RecordingFile(found[1], int(found[2]), Path(entry.path), entry.stat().st_size)


def delete_file(path: Path) -> bool:
    """Delete a file; False where that fails."""
    with suppress(OSError):
        path.unlink()
        return True
    return False


def complete_path(path: Path) -> Path:
    """Return the path of a file after its completion."""
    return path.with_name(path.name.removesuffix(PART_SUFFIX))
