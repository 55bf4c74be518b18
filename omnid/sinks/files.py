"""Where a run may write, found out before it starts; and the files that it writes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import TypeAlias

import cv2

from omnid.errors import OmnidError
from omnid.formats.plan_view import plan_view
from omnid.formats.ply import write_ply
from omnid.formats.tum import tum_row
from omnid.messages import MapUpdate, OdometryUpdate

Named: TypeAlias = Sequence[tuple[str, Path]]


def check_outputs(outputs: Named, inputs: Named) -> None:
    """OmnidError unless every (option, path) can be written, no two are one file and none is an input (what, path)."""
    taken = {_identity(path): what for what, path in inputs}
    for option, path in outputs:
        _require_writable(option, path)
        other = taken.setdefault(_identity(path), option)
        if other != option and path.exists() == path.is_file():
            raise OmnidError(f"{option} {path}: this is {other} as well; name another file")


def on_stdout(outputs: Named) -> bool:
    """Whether one of the outputs is the standard output, so that nothing else may be said there."""
    try:
        found = os.fstat(1)
    except OSError:
        return False
    return any(path.exists() and os.path.samestat(path.stat(), found) for _, path in outputs)


def _identity(path: Path) -> tuple[int, int] | str:
    """The same for all names of a file, links of either kind among them."""
    try:
        found = path.stat()
        return found.st_dev, found.st_ino
    except OSError:
        return os.path.realpath(path)


def _require_writable(option: str, path: Path) -> None:
    try:
        _refuse_what_is_no_file(option, path)
        _try(path)
    except OSError as error:
        raise OmnidError(f"{option} {path}: cannot be written: {error.strerror or error}; name another file") from error


def _refuse_what_is_no_file(option: str, path: Path) -> None:
    if str(path) == "-":
        raise OmnidError(f"{option} -: expected the name of a file; the standard output is called /dev/stdout")
    if path.is_dir():
        raise OmnidError(f"{option} {path}: expected a file to write, found a folder")
    if not path.parent.is_dir():
        raise OmnidError(f"{option} {path}: there is no folder {path.parent}; make it first")
    if option in ("--map", "--plan") and path.exists() and not path.is_file():
        raise OmnidError(f"{option} {path}: expected a file that can be replaced, found a device or a pipe")


def _try(path: Path) -> None:
    """Raises OSError where a file cannot be opened for writing; leaves no trace."""
    if path.exists() and not path.is_file():
        return  # opening a pipe to try it would end its reader
    fresh = not path.exists()
    with path.open("ab"):
        pass
    if fresh:
        os.unlink(os.path.realpath(path))  # where path is a link, it stays one


class TrajectoryFile:
    """T_odom_rig as TUM, a whole line for every pair as soon as it is known.

    The file is opened for the first of them: a run that finds none leaves what was there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: FileIO | None = None
        self._whole_bytes = 0

    def process(self, odometry: OdometryUpdate) -> None:
        """Adds the row of a pose."""
        try:
            self._append(tum_row(odometry.stamp_ns, odometry.T_odom_rig).encode("ascii") + b"\n")
        except OSError as error:
            raise OmnidError(f"{self._path}: cannot be written any more: {error.strerror or error}") from error

    def finish(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _append(self, row: bytes) -> None:
        if self._file is None:
            self._file = self._path.open("wb", buffering=0)
        try:
            written = self._file.write(row)
            while written < len(row):  # a disk that fills takes a part, then nothing
                written += self._file.write(row[written:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._whole_bytes)  # half a row would be none
            raise
        self._whole_bytes += len(row)


class MapFile:
    """The map as PLY, at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def process(self, update: MapUpdate) -> None:
        """Writes the map."""
        write_ply(self._path, update.points)


class PlanFile:
    """The map from above with the path, as PNG, at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def process(self, update: MapUpdate) -> None:
        """Writes the image."""
        image = cv2.imencode(".png", plan_view(update.points, update.path_xy))[1]
        try:
            self._path.write_bytes(image.tobytes())
        except OSError as error:
            raise OmnidError(f"{self._path}: cannot be written: {error.strerror or error}") from error
