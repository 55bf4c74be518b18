"""A rig that a run has refined, as a file: the whole rig, and the table [refined] with the calibration it belongs to.

The file is a `rig.toml` that any command reads. It belongs to the calibration whose digest it holds: after another
calibration it is out of date. Masks, topics and the pose on the robot are always those of the calibration's own file.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.rig import MountedCamera, Rig
from calib.rig_file import parse_rig, rig_toml
from calib.validation import read_bytes, toml_table

HEADER = (
    "# A rig that omnid has refined while the robot drove. Delete this file to go back to the calibration.\n"
    "# rig.refine in the configuration says whether a start uses it.\n"
)


@dataclass(frozen=True, slots=True)
class RefinedRig:
    """A refined rig and its provenance."""

    rig: Rig
    base_sha256: str  # of the calibration that it refines, see `calibration_digest`
    written: str  # date and time (UTC)
    keyframes: int  # of the newest window of the drive
    landmarks: int
    error_px: float  # of a landmark's coordinate with the rig of the run
    refined_error_px: float
    lengths: float  # relative change of lengths against the calibration
    lengths_sigma: float

    @property
    def summary(self) -> str:
        """Time of the refinement and the change, in one line."""
        return (
            f"refined {self.written}: lengths {100 * self.lengths:+.3f} % (sigma {100 * self.lengths_sigma:.3f}) "
            f"against the calibration, landmarks {self.error_px:.3f} -> {self.refined_error_px:.3f} px"
        )

    def applied_to(self, base: Rig) -> Rig:
        """Return the calibration with the refined cameras, transforms, times and covariance."""
        lower, upper = (
            replace(own, camera=refined.camera, T_cam_rig=refined.T_cam_rig)
            for own, refined in ((base.lower, self.rig.lower), (base.upper, self.rig.upper))
        )
        return replace(base, lower=lower, upper=upper, covariance=self.rig.covariance, times=self.rig.times)

    def toml(self) -> str:
        """Return the text of the file."""
        table = (
            "\n[refined]\n"
            f'base_sha256 = "{self.base_sha256}"\nwritten = "{self.written}"\n'
            f"keyframes = {self.keyframes}\nlandmarks = {self.landmarks}\n"
            f"error_px = {self.error_px:.6f}\nrefined_error_px = {self.refined_error_px:.6f}\n"
            f"lengths = {self.lengths:.8f}\nlengths_sigma = {self.lengths_sigma:.8f}\n"
        )
        return HEADER + rig_toml(self.rig) + table


def calibration_digest(rig: Rig) -> str:
    """Return the SHA-256 of what a refinement starts from: cameras, transforms, times and covariance.

    Masks, topics and T_base_rig are left out: they may be edited without a new calibration.
    """
    cameras = [MountedCamera(mounted.camera, mounted.T_cam_rig) for mounted in (rig.lower, rig.upper)]
    bare = Rig(cameras[0], cameras[1], np.eye(4), ("", ""), rig.covariance, rig.times)
    return hashlib.sha256(rig_toml(bare).encode()).hexdigest()


def read_refined_rig(path: Path) -> RefinedRig | None:
    """Read a refined rig; None if the file is a rig without the table [refined], CalibError if it is no rig."""
    data = read_bytes(path)
    table, rig = toml_table(data, str(path)), parse_rig(data, path.parent, str(path))
    if not table.has("refined"):
        return None
    refined = table.table("refined")
    names = ("error_px", "refined_error_px", "lengths", "lengths_sigma")
    refined.allow_only(("base_sha256", "written", "keyframes", "landmarks", *names))
    error_px, refined_error_px, lengths, lengths_sigma = (refined.number(name) for name in names)
    return RefinedRig(
        rig,
        refined.text("base_sha256"),
        refined.text("written"),
        int(refined.number("keyframes")),
        int(refined.number("landmarks")),
        error_px,
        refined_error_px,
        lengths,
        lengths_sigma,
    )
