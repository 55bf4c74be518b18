"""Selection between central cameras and cameras of real mirrors for a rig, by cross-validation on held-out views.

Only boards seen by both cameras of a rig show well that the rays of a mirror camera do not meet in one point; without
these terms the directions of far objects are wrong by tenths of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.boards.board import CalibrationBoard
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.errors import CalibError
from calib.fit.boards.rig_fit import RigCalibration, fit_rig, rig_held_out_px
from calib.fit.boards.rig_problem import PairView, Sides
from calib.models.ocam import OcamCamera

# The polynomial of a round mirror has even powers; higher ones are not needed for mirrors near the paraboloid.
POWERS = (0, 2, 4)
# Number of radii at which polynomials are compared: enough for three coefficients.
RADII = 60
# Start values of terms that are fitted: a wavefront [m], tangential terms [1/px], so small that no pixel changes,
# because 0 stands for a term that is not fitted.
START_M, START_TANGENTIAL = 1e-9, (1e-12, 1e-12)
# The more general rig is selected if its held-out error is lower by this part.
MIN_IMPROVEMENT = 0.01
# Mirrors below telecentric lenses are selected if their cost is larger by less, in variances of a coordinate, because
# the sum of squares of ten normal values, of the five terms of both wavefronts, is larger once in twenty times.
# Ray-traced paraboloids had 5, hyperboloids of xi = 0.97 had 23 with twelve pairs.
MAX_MORE_VARIANCES = 18.3


@dataclass(frozen=True, slots=True)
class RigScore:
    """The quality of a rig's fit: errors [px]; held_out_px NaN if it was not needed."""

    name: str
    parameters: int
    mean_px: float
    held_out_px: float

    def __str__(self) -> str:
        held_out = f", held out {self.held_out_px:.3f} px" if np.isfinite(self.held_out_px) else ""
        return f"{self.name}: {self.parameters} parameters, mean {self.mean_px:.4f} px{held_out}"


@dataclass(frozen=True, slots=True)
class SelectedRig:
    """A rig's calibration, and the scores of the rigs that were compared, the selected one first."""

    calibration: RigCalibration
    scores: tuple[RigScore, ...]


def select_rig(
    views: Sequence[PairView],
    board: CalibrationBoard,
    cameras: Sides,
    mirrors: tuple[OcamCamera, OcamCamera] | None,
    shape: PrintShape = AS_DRAWN,
) -> SelectedRig:
    """Calibrate a rig with central cameras, and with the terms of real mirrors; select by the held-out error.

    mirrors: ocam cameras from which the terms of real mirrors are fitted, None: central cameras only. shape: start
    value of the print's shape, whose free modes are fitted. Raises CalibError as fit_rig does for the central cameras.
    """
    central = fit_rig(views, board, cameras, shape=shape)
    if mirrors is None:
        return SelectedRig(central, ())
    try:
        general = fit_rig(central.views, board, (mirror_start(mirrors[0]), mirror_start(mirrors[1])), shape=shape)
    except (CalibError, np.linalg.LinAlgError):
        return SelectedRig(central, (_score("central cameras", central, np.nan),))
    general = telecentric_if_as_good(general)
    if not _may_be_better(central, general):
        scores = (_score("central cameras", central, np.nan), _score(_name(general), general, np.nan))
        return SelectedRig(central, scores)
    scores = (
        _score("central cameras", central, rig_held_out_px(central)),
        _score(_name(general), general, rig_held_out_px(general)),
    )
    if scores[1].held_out_px < (1 - MIN_IMPROVEMENT) * scores[0].held_out_px:
        return SelectedRig(replace(general, rejected=(*central.rejected, *general.rejected)), scores[::-1])
    return SelectedRig(central, scores)


def telecentric_if_as_good(general: RigCalibration) -> RigCalibration:
    """Return the rig of mirrors below telecentric lenses if that explains the corners as well, else the one given."""
    try:
        found = fit_rig(
            general.views, general.board, (general.lower, general.upper), shape=general.shape, telecentric=True
        )
    except (CalibError, np.linalg.LinAlgError):
        return general
    freedom = 2 * int(np.isfinite(general.fit.errors_px).sum()) - len(general.fit.parameters) - 6 * len(general.views)
    more = (found.fit.cost - general.fit.cost) / (general.fit.cost / max(1, freedom))
    is_as_good = len(found.views) == len(general.views) and more < MAX_MORE_VARIANCES
    return replace(found, rejected=general.rejected) if is_as_good else general


def mirror_start(camera: OcamCamera) -> OcamCamera:
    """Return the camera from which the terms of a real mirror are fitted: even powers, terms of almost 0.

    The even powers are fitted to the camera's polynomial over the image: leaving out its odd ones would spoil the poses
    of the boards from which the fit starts.
    """
    radii = np.linspace(0, min(camera.size) / 2, RADII) / min(camera.size)
    found = np.linalg.lstsq(radii[:, None] ** POWERS, camera.height(radii * min(camera.size)), rcond=None)[0]
    even = np.zeros(POWERS[-1] + 1)
    even[list(POWERS)] = found / float(min(camera.size)) ** np.array(POWERS)
    tangential = camera.tangential if any(camera.tangential) else START_TANGENTIAL
    return replace(
        camera, polynomial=tuple(even.tolist()), tangential=tangential, wavefront=(START_M,) * len(camera.wavefront)
    )


def _may_be_better(central: RigCalibration, general: RigCalibration) -> bool:
    """False if the further parameters explain no more of the squared residuals than they would of pure noise."""
    squares = [
        float(np.nansum(np.minimum(found.fit.errors_px, 5 * np.nanmedian(found.fit.errors_px)) ** 2))
        for found in (central, general)
    ]
    more = len(general.fit.parameters) - len(central.fit.parameters)
    count = 2 * int(np.isfinite(general.fit.errors_px).sum())
    return len(general.views) >= len(central.views) and squares[1] < squares[0] * (1 - 2 * max(0, more) / count)


def _name(general: RigCalibration) -> str:
    return "cameras below paraboloids" if general.telecentric else "non-central cameras"


def _score(name: str, found: RigCalibration, held_out: float) -> RigScore:
    return RigScore(name, len(found.fit.parameters), found.fit.mean_px, held_out)
