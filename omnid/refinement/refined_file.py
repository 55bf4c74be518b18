"""The file of the refined rig: a run writes it, and a start of the next run uses it.

The file of the calibration is never written. What is in the refined file belongs to one calibration, by its digest; a
start ignores the file of another one, and the next refinement replaces it.
"""

from __future__ import annotations

import logging
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from calib.errors import CalibError
from calib.fit.drive.rig_parameters import ANGLE_UNIT_RAD, RigParameters
from calib.refined_rig import RefinedRig, calibration_digest, read_refined_rig
from calib.rig import Rig
from omnid.engine.logging_setup import Report
from omnid.errors import OmnidError
from omnid.formats.whole_file import write_whole
from omnid.refinement.estimate import RigChange

# Larger changes against the calibration are reported and not written: the rig was knocked, or is another one. A mirror
# that is mounted again lies within these limits.
MAX_LENGTHS, MAX_RAD = 0.05, np.deg2rad(1.0)

ANOTHER: Final = "it refines another calibration than {rig}, which was calibrated since: it is not used; delete it"
SAME: Final = "rig.refined_file is the file of the calibration, cameras.rig, which no run writes: name another one"
NOT_OURS: Final = "it is a rig that no run of omnid has refined: it is neither used nor written; name another file"


class RefinedRigFile:
    """The refined rig of one calibration, as a file."""

    def __init__(self, path: Path, calibration: Rig, calibration_path: Path) -> None:
        self._path, self._calibration, self._calibration_path = path, calibration, calibration_path
        self._digest = calibration_digest(calibration)
        self._before: bytes | None = None  # content before the first change of this run
        self._is_written = False
        self.used: RefinedRig | None = None  # with which the run began

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._path

    def start(self, report: Report, *, is_wanted: bool) -> Rig:
        """Return the rig to begin a run with: the refined one if it is wanted and belongs to the calibration.

        report: takes a level of `logging` and a line that names the rig in use wherever there is a refined file.
        """
        if not self._path.exists():
            return self._calibration
        try:
            refined = self._read()
        except (CalibError, OmnidError) as error:
            report(logging.WARNING, f"{error}; the run uses {self._calibration_path}")
            return self._calibration
        if not is_wanted:
            report(logging.INFO, f"{self._path}: {refined.summary}: not used, as rig.refine is not 'use'")
            return self._calibration
        self.used = refined
        report(
            logging.INFO,
            f"the rig of this run is {self._path}, {refined.summary}; delete the file to go back to "
            f"{self._calibration_path}",
        )
        return refined.applied_to(self._calibration)

    def write(self, change: RigChange) -> RefinedRig:
        """Write the rig of a change and return it; OmnidError, which gives the reason, where it is not written."""
        # 1. Lengths and transforms add up from run to run: the limits hold against the calibration.
        before = 1.0 if self.used is None else 1.0 + self.used.lengths
        lengths = before * (1.0 + change.lengths) - 1.0
        steps = RigParameters.about(self._calibration).transform_steps(change.rig)
        moved_rad = ANGLE_UNIT_RAD * float(np.abs(steps).max())
        if abs(lengths) > MAX_LENGTHS or moved_rad > MAX_RAD:
            self.withdraw()
            raise OmnidError(
                f"the change is too large to be used unseen (lengths by {100 * lengths:+.2f} %, upper "
                f"camera by {np.rad2deg(moved_rad):.2f} deg against {self._calibration_path})"
            )
        # 2. The calibration, and any file that is no refined rig, belong to the user.
        self._require_ours()
        if not self._is_written:
            self._before = self._path.read_bytes() if self._path.exists() else None
        # 3. Write it with its provenance.
        refined = RefinedRig(
            change.rig,
            self._digest,
            datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            change.keyframes,
            change.landmarks,
            change.error_px,
            change.refined_error_px,
            lengths,
            change.lengths_sigma,
        )
        write_whole(self._path, refined.toml().encode())
        self._is_written = True
        return refined

    def withdraw(self) -> bool:
        """Restore what was there before this run wrote; False where it wrote nothing."""
        if not self._is_written:
            return False
        if self._before is None:
            self._path.unlink(missing_ok=True)
        else:
            write_whole(self._path, self._before)
        self._is_written = False
        return True

    def _read(self) -> RefinedRig:
        """Return the refined rig of this calibration; CalibError or OmnidError where the file holds none."""
        refined = self._require_ours()
        assert refined is not None
        if refined.base_sha256 != self._digest:
            raise OmnidError(f"{self._path}: {ANOTHER.format(rig=self._calibration_path)}")
        return refined

    def _require_ours(self) -> RefinedRig | None:
        """Return the refined rig of the file, None where there is no file; OmnidError for a file of the user."""
        if self._path.resolve() == self._calibration_path.resolve():
            raise OmnidError(SAME)
        if not self._path.exists():
            return None
        refined = read_refined_rig(self._path)
        if refined is None:
            raise OmnidError(f"{self._path}: {NOT_OURS}")
        return refined
