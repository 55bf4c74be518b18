"""The cost of a rig's errors for a drive, in words: per cent of its length and degrees of its heading."""

from __future__ import annotations

from collections.abc import Sequence

from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty
from omnid.calibration.camera import misfit_warning
from omnid.calibration.image_pairs import SIDES

# Part of the length by which a drive may be wrong: from MISFIT_PART on a camera model that leaves more than noise is
# called a misfit, up to GOOD_PART a rig is called good. Wheels are wrong by about a per cent.
MISFIT_PART, GOOD_PART = 0.003, 0.001


def accuracy_warnings(structures: Sequence[ResidualStructure], drives: DriveUncertainty | None) -> list[str]:
    """Return a line for each camera whose model leaves more than noise at a cost, or one if noise alone costs as much.

    structures: of the residuals of the lower and the upper camera. drives None: the cost is not known.
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
    if not misfits and drives.length_part >= MISFIT_PART:
        lines = [f"the images leave much open: {cost}; add pairs with the board near, tilted, and on all sides"]
    return lines
