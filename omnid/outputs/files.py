"""Where a run may write, found out before it starts; and the files that it writes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import cv2

from omnid.core.plan_view import plan_view
from omnid.core.ply import write_ply
from omnid.core.trajectory import tum_row
from omnid.errors import OmnidError
from omnid.messages import MapUpdate, Odometry


def check_outputs(paths: Sequence[tuple[str, Path]], log: Path) -> None:
    """OmnidError unless every (option, path) can be written, no two are one file and none is the log that is read."""
    taken: dict[Path, str] = {log.resolve(): "the log that is read"}
    for option, path in paths:
        _require_writable(option, path)
        other = taken.setdefault(path.resolve(), option)
        if other != option and path.exists() == path.is_file():
            raise OmnidError(f"{option} {path}: this is {other} as well; name another file")


def _require_writable(option: str, path: Path) -> None:
    if path.is_dir():
        raise OmnidError(f"{option} {path}: expected a file to write, found a folder")
    if not path.parent.is_dir():
        raise OmnidError(f"{option} {path}: there is no folder {path.parent}; make it first")
    if option in ("--map", "--plan") and path.exists() and not path.is_file():
        raise OmnidError(f"{option} {path}: expected a file that can be replaced, found a device or a pipe")
    if path.exists() and not path.is_file():
        return  # opening a pipe to try it would end its reader
    fresh = not path.exists()
    try:
        with path.open("ab"):
            pass
        if fresh:
            path.unlink()
    except OSError as error:
        raise OmnidError(f"{option} {path}: cannot be written: {error.strerror or error}; name another file") from error


class TrajectoryFile:
    """T_odom_rig as TUM, a whole line for every pair as soon as it is known."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: TextIO = _opened(path)

    def process(self, odometry: Odometry) -> None:
        """Adds the row of a pose."""
        try:
            self._file.write(tum_row(odometry.stamp_ns, odometry.T_odom_rig) + "\n")
            self._file.flush()
        except OSError as error:
            raise OmnidError(f"{self._path}: cannot be written any more: {error.strerror or error}") from error

    def finish(self) -> None:
        """Closes the file."""
        self._file.close()


def _opened(path: Path) -> TextIO:
    try:
        return path.open("w", encoding="ascii", newline="\n")
    except OSError as error:
        raise OmnidError(f"{path}: cannot be written: {error.strerror or error}; name another file") from error


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
        """Writes the picture."""
        picture = cv2.imencode(".png", plan_view(update.points, update.path_xy))[1]
        try:
            self._path.write_bytes(picture.tobytes())
        except OSError as error:
            raise OmnidError(f"{self._path}: cannot be written: {error.strerror or error}") from error
