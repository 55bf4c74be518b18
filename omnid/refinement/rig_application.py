"""Use of a refined rig: by the stages of a run from the next pair on, and in the file of the rig."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from calib.errors import CalibError
from calib.rig import Rig
from calib.rig_file import rig_toml, write_file
from omnid.refinement.estimate import RigChange
from omnid.stages.geometry import GeometryVersions

# First line of a file that was refined; a file without it is a calibration.
MARK = "# refined by omnid run; the calibration before: "


class RigApplication:
    """Lets a run go on with refined rigs, and writes them to the file from which the rig was read.

    Beside `rig.toml`, `rig.original.toml` is the newest calibration, and `rig.previous.toml` the rig before the newest
    change. A file that changed since it was read or written here is left as it is: somebody has calibrated.
    """

    def __init__(self, versions: GeometryVersions, path: Path | None, publish: Callable[[Rig], None],
                 report: Callable[[str], None]) -> None:
        """path: of the rig's file, None: nothing is written. publish: takes each rig that the run begins to use.

        report: takes a line for the log.
        """
        self._versions, self._path, self._publish, self._report = versions, path, publish, report
        self._known = _content(path) if path is not None else b""

    def __call__(self, change: RigChange) -> str:
        """Begin to use the rig of a change; return the file that was written, or why none was."""
        self._versions.add(change.rig)
        self._publish(change.rig)
        try:
            file = self._write(change.rig)
        except CalibError as error:
            file = f"not written: {error}"
        surest = int(np.argmax(np.abs(change.after - change.before) / change.sigmas))
        self._report(f"the run goes on with a refined rig: lengths {100 * change.lengths:+.3f} % (sigma "
                     f"{100 * change.lengths_sigma:.3f}), {change.names[surest]} {change.before[surest]:.6g} -> "
                     f"{change.after[surest]:.6g}, landmarks {change.error_px:.3f} -> {change.refined_error_px:.3f} "
                     f"px; {file}")
        return file

    def _write(self, rig: Rig) -> str:
        """Write the rig's file and keep what was there; CalibError where that is not possible."""
        path = self._path
        if path is None:
            return "not written: the rig was not read from a file of its own"
        before = _content(path)
        if not before or before != self._known:
            return f"not written: {path} was changed while this run used another rig"
        original = path.with_name(f"{path.stem}.original{path.suffix}")
        if not before.startswith(MARK.encode()):
            write_file(original, before)
        write_file(path.with_name(f"{path.stem}.previous{path.suffix}"), before)
        self._known = f"{MARK}{original.name}\n{rig_toml(rig)}".encode()
        write_file(path, self._known)
        return str(path)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
