"""The output files of a run, and the check of their paths before it starts."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.logs.image_folder import IMAGE_SUFFIXES
from drivers.logs.mcap_writer import is_locked, lock
from drivers.logs.open_log import is_log_name
from omnid.core.mapping.voxel_map import MapPoints
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.formats.plan import NO_LOOPS, plan_view
from omnid.formats.tum import tum_row
from omnid.messages import OdometryUpdate

Named: TypeAlias = Sequence[tuple[str, Path]]
# Options of files that are replaced at once -> the ends that their names may have, where they have one.
REPLACED: Final = {"--cloud": (".ply",), "--plan": (".png",), "--ply": (".ply",), "--grid": (".yaml", ".yml")}


def check_outputs(outputs: Named, inputs: Named) -> None:
    """Check that all outputs (option, path) can be written, and none is another one, an input (name, path) or in use.

    Of a folder that is an input, the logs and images are inputs as well. Leaves no file behind. Raises OmnidError.
    """
    used = {_identity(path): what for what, path in inputs}
    folders = [folder.resolve() for _, folder in inputs if folder.is_dir()]
    for option, path in outputs:
        wrong = _why_not_written(option, path)
        other = used.setdefault(_identity(path), option)
        if not wrong and other != option and path.exists() == path.is_file():
            wrong = f"this is {other} as well"
        folder = next((folder for folder in folders if folder in path.resolve().parents), None)
        is_image = path.suffix.lower() in IMAGE_SUFFIXES and option != "--plan"
        if not wrong and folder is not None and (is_image or is_log_name(path.name)) and path.is_file():
            wrong = f"this is a file of {folder}, which is read"
        if wrong:
            raise OmnidError(f"{option} {path}: {wrong}; name another file")


def on_stdout(outputs: Named) -> bool:
    """True if one of the outputs is the standard output, so that no other text may be printed there."""
    with suppress(OSError):
        found = os.fstat(1)
        return any(path.exists() and os.path.samestat(path.stat(), found) for _, path in outputs)
    return False


def _identity(path: Path) -> tuple[int, int] | str:
    """Return a key that is the same for all names of a file, hard and symbolic links included."""
    with suppress(OSError):
        found = path.stat()
        return found.st_dev, found.st_ino
    return os.path.realpath(path)


def _why_not_written(option: str, path: Path) -> str:
    """Return why a file cannot be written; empty if it can."""
    endings = REPLACED.get(option, ())
    try:
        if path.is_dir():
            return "expected a file to write, found a folder"
        if not path.parent.is_dir():
            return f"there is no folder {path.parent}"
        if endings and path.suffix and path.suffix.lower() not in endings:
            return f"expected a name that ends in {endings[0]}"
        if path.exists() and not path.is_file():  # not opened: a pipe that is opened and closed would end its reader
            return "expected a file that can be replaced, found a device or a pipe" if endings else ""
        is_new = not path.exists()
        path.open("ab").close()
        if is_new:
            os.unlink(os.path.realpath(path))  # where path is a link, it stays one
        elif is_locked(path):
            return "another program is writing it"
    except OSError as error:
        return f"cannot be written: {error.strerror or error}"
    return ""


class TrajectoryFile:
    """A trajectory as TUM, one line a pose, written as soon as the pose is known.

    The file is opened for the first pose: a run without poses leaves an existing file as it was.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: FileIO | None = None
        self._whole_bytes = 0

    def process(self, odometry: OdometryUpdate) -> None:
        """Write the row of a pose T_odom_rig."""
        self.write(odometry.stamp_ns, odometry.T_odom_rig)

    def write(self, stamp_ns: int, T: NDArray[np.float64]) -> None:
        """Write the row of a pose (4, 4). Raises OmnidError."""
        try:
            if self._file is None:
                self._file = self._path.open("wb", buffering=0)
                lock(self._file)
            row = tum_row(stamp_ns, T).encode("ascii") + b"\n"
            if self._file.write(row) != len(row):
                self._file.truncate(self._whole_bytes)  # remove the part of a row
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._whole_bytes += len(row)
        except OSError as error:
            raise _no_longer_written(self._path, error) from error

    def finish(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def write_trajectory(path: Path, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
    """Write poses (N, 4, 4) as TUM; without poses an existing file stays as it is. Raises OmnidError."""
    file = TrajectoryFile(path)
    try:
        for stamp_ns, T in zip(stamps_ns.tolist(), poses, strict=True):
            file.write(stamp_ns, T)
    finally:
        file.finish()


def write_known(
    path: Path, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64], known: NDArray[np.bool_]
) -> list[str]:
    """Write those of poses in the map (N, 4, 4) that are known (N,), as TUM; return warnings about the others.

    Raises OmnidError.
    """
    if len(poses) and not known.any():
        try:
            path.write_bytes(b"")  # no poses of an earlier run
        except OSError as error:
            raise _no_longer_written(path, error) from error
    write_trajectory(path, stamps_ns[known], poses[known])
    if known.all():
        return []
    left_out = f"{len(known) - known.sum()} of {len(known)} poses are left out"
    return [f"{path}: {left_out}: no place of the map was recognised there, so it is not known where in it they are"]


def _no_longer_written(path: Path, error: OSError) -> OmnidError:
    return OmnidError(f"{path}: can no longer be written: {error.strerror or error}")


def write_plan(
    path: Path,
    points: MapPoints,
    path_xy: NDArray[np.float64],
    heights_m: tuple[float, float],
    loops_xy: NDArray[np.float64] = NO_LOOPS,
) -> None:
    """Write the plan view of points between two heights [m], as `plan_view` draws it. Raises OmnidError."""
    image = plan_view(points, path_xy, heights_m=heights_m, loops_xy=loops_xy)
    write_whole(path, cv2.imencode(".png", image)[1].tobytes())
