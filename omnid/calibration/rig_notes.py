"""What limits a calibrated rig: how wrong its errors make a drive, and which boards the calibration lacks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib import se3
from calib.fit.boards.rig_problem import PairView
from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import DriveUncertainty, seen_points
from calib.models.camera import Array
from calib.rig import Rig
from omnid.calibration.images import SIDES

# Relative error of a drive's length. Up to GOOD_PART there is no warning. From MISFIT_PART on the warning advises
# against the rig: that is a third of the error of wheels, about a per cent, which the cameras are to improve on.
MISFIT_PART, GOOD_PART = 0.003, 0.001
# Six pairs, spread over the azimuth, lower the error of lengths to a third or less.
MORE_PAIRS = 6
# Corners and rays are counted up to this percentile: the last ones are those of one slanted board.
HIGHEST_PERCENT = 98.0


def accuracy_warnings(
    structures: Sequence[ResidualStructure], drives: DriveUncertainty | None, missing: str
) -> list[str]:
    """Return the warnings, none for a rig that is accurate enough.

    A camera whose residuals are more than noise has a line; where both have noise only, one line asks for more pairs.
    structures: those of the residuals of the lower and the upper camera. drives: the error of drives that follows from
    the rig's covariance; None: it is not known. missing: which pairs to add.
    """
    misfits = [
        f"{name} camera: the camera model does not describe this camera: {structure}"
        for name, structure in zip(SIDES, structures, strict=True)
        if structure.is_misfit
    ]
    if drives is None:
        return [f"{line}; do not use it where accuracy matters" for line in misfits]
    if drives.length_part <= GOOD_PART:
        return []
    cost = (
        f"drives may be wrong by {100 * drives.length_part:.2g} % of their length and by {drives.heading_deg_m:.2g} "
        "degree of heading per metre"
    )
    advice = ": do not use it where that matters" if drives.length_part >= MISFIT_PART else ""
    lines = [f"{line}; {cost}{advice}" for line in misfits]
    return lines or [f"the images leave something open: {cost}; {missing}"]


def missing_views(views: Sequence[PairView], rig: Rig) -> str:
    """Return which pairs to add: of the camera, and of higher or lower boards, where the most elevations are missing.

    The profile of a mirror is extrapolated from the elevations of the corners to those of a drive, whose lengths depend
    on it.
    """
    points, gaps = seen_points(rig), list[tuple[float, str, float, float, str]]()
    if not len(points):
        return ""
    for side, (name, mounted) in enumerate(zip(SIDES, (rig.lower, rig.upper), strict=True)):
        pixels = np.concatenate([seen.pixels for view in views if (seen := view.seen[side]) is not None])
        R_rect_cam = rig.T_rect_rig[:3, :3] @ mounted.T_cam_rig[:3, :3].T
        corners = _elevations_deg(mounted.camera.lift(pixels[np.isfinite(pixels[:, 0])]) @ R_rect_cam.T)
        needed = _elevations_deg(points - se3.apply(rig.T_rect_rig, mounted.viewpoint[None]))
        for word, percent, sign in (("higher", HIGHEST_PERCENT, 1), ("lower", 100 - HIGHEST_PERCENT, -1)):
            reached, wanted = (float(np.nanpercentile(part, percent)) for part in (corners, needed))
            gaps.append((sign * (wanted - reached), name, reached, wanted, word))
    _, name, reached, wanted, word = max(gaps)
    return (
        f"the {name} camera saw boards to an elevation of {reached:+.0f} deg only, a drive looks to {wanted:+.0f} deg: "
        f"add {MORE_PAIRS} pairs with the board {word}, all around"
    )


def _elevations_deg(rays: Array) -> Array:
    """Return the angles (N,) of rays (N, 3) in the rectified frame above the plane across the baseline."""
    return np.asarray(np.rad2deg(np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))))
