"""The output files of a run, and the check of their paths before it starts."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from io import FileIO
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import files_in
from omnid.errors import OmnidError
from omnid.formats.tum import tum_row
from omnid.messages import OdometryUpdate

Named: TypeAlias = Sequence[tuple[str, Path]]


def check_outputs(outputs: Named, inputs: Named) -> None:
    """Check that all outputs (option, path) can be written, and none is another one or an input (name, path).

    Inputs are files, or folders of logs or images. Leaves no file behind. Raises OmnidError.
    """
    used = {_identity(file): what for what, path in inputs for file in (path, *files_in(path))}
    for option, path in outputs:
        wrong = ""
        if path.is_dir():
            wrong = "expected a file to write, found a folder"
        elif not path.parent.is_dir():
            wrong = f"there is no folder {path.parent}"
        elif (other := used.setdefault(_identity(path), option)) != option:
            wrong = f"this is {other} as well"
        elif not os.access(path if path.exists() else path.parent, os.W_OK):
            wrong = "there is no permission to write it"
        if wrong:
            raise OmnidError(f"{option} {path}: {wrong}; name another file")


def _identity(path: Path) -> object:
    """Return a key that is the same for all names of a file, links included; pipes and devices may be used twice."""
    if path.exists() and not path.is_file():
        return object()
    return (path.stat().st_dev, path.stat().st_ino) if path.exists() else path.resolve()


class TrajectoryFile:
    """A trajectory as TUM, one line a pose, written as soon as the pose is known.

    The file is opened for the first pose: a run without poses leaves an existing file as it was.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: FileIO | None = None

    def process(self, odometry: OdometryUpdate) -> None:
        """Write the row of a pose T_odom_rig. Raises OmnidError."""
        row = tum_row(odometry.stamp_ns, odometry.T_odom_rig).encode("ascii") + b"\n"
        try:
            if self._file is None:
                self._file = self._path.open("wb", buffering=0)
            written = self._file.write(row)
            if written != len(row):
                self._file.truncate(self._file.tell() - written)  # Remove the part of a row.
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise OmnidError(f"{self._path}: can no longer be written: {error.strerror or error}") from error

    def finish(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def write_trajectory(path: Path, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
    """Write poses (N, 4, 4) as TUM. Raises OmnidError."""
    rows = [tum_row(stamp_ns, T) + "\n" for stamp_ns, T in zip(stamps_ns.tolist(), poses, strict=True)]
    try:
        path.write_text("".join(rows), "ascii")
    except OSError as error:
        raise OmnidError(f"{path}: cannot be written: {error.strerror or error}") from error
