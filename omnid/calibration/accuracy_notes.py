"""Warnings about a calibrated rig: how wrong its errors make a drive, in per cent of length and degrees of heading."""

from __future__ import annotations

from collections.abc import Sequence

from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty
from omnid.calibration.camera import misfit_warning
from omnid.calibration.image_pairs import SIDES

# Relative error of a drive's length. Up to GOOD_PART there is no warning. From MISFIT_PART on the warning advises
# against the rig: that is a third of the error of wheels, about a per cent, which the cameras are to improve on.
MISFIT_PART, GOOD_PART = 0.003, 0.001


def accuracy_warnings(
    structures: Sequence[ResidualStructure], drives: DriveUncertainty | None, missing: str
) -> list[str]:
    """Return the warnings, none for a rig that is accurate enough.

    A camera whose residuals are more than noise has a line; where both have noise only, one line asks for more pairs.
    structures: those of the residuals of the lower and the upper camera. drives: the error of drives that follows from
    the rig's covariance; None: it is not known. missing: which pairs to add.
    """
    misfits = [(name, structure) for name, structure in zip(SIDES, structures, strict=True) if structure.is_misfit]
    if drives is None:
        return [line for name, structure in misfits for line in misfit_warning(f"{name} camera", structure)]
    if drives.length_part <= GOOD_PART:
        return []
    cost = (
        f"drives may be wrong by {100 * drives.length_part:.2g} % of their length and by {drives.heading_deg_m:.2g} "
        "degree of heading per metre"
    )
    advice = ": do not use it where that matters" if drives.length_part >= MISFIT_PART else ""
    lines = [
        f"{name} camera: the camera model does not describe this camera: {structure}; {cost}{advice}"
        for name, structure in misfits
    ]
    return lines or [f"the images leave something open: {cost}; {missing}"]
