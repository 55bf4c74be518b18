"""Selection of the camera model by cross-validation on held-out views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import BoardView, CalibrationBoard
from calib.boards.print_shape import AS_DRAWN, PrintShape
from calib.errors import CalibError
from calib.fit.boards.camera_fit import (
    CameraCalibration,
    calibrate_consistent,
    consistent_views,
    observations,
    refine_camera_calibration,
)
from calib.fit.boards.camera_models import MODELS, FittedModel, Model
from calib.fit.boards.cross_validation import held_out_error_px
from calib.fit.residual_structure import ResidualStructure, residual_structure
from calib.models.ocam import OcamCamera, View

# "auto" fits every model and selects the best.
ModelChoice = Literal["auto", "omni", "ocam", "ocam_tangential"]
MODEL_CHOICES: tuple[ModelChoice, ...] = ("auto", *MODELS)
# The other models start from the ocam camera.
FIT_ORDER: tuple[Model, ...] = ("ocam", *(model for model in MODELS if model != "ocam"))
# Of models whose held-out errors differ by less than this part, the one with the fewest parameters is selected.
TIE_PART = 0.01


@dataclass(frozen=True, slots=True)
class ModelScore:
    """The quality of one model's fit: errors [px] and the structure of its residuals."""

    model: Model
    parameters: int
    mean_px: float
    held_out_px: float
    structure: ResidualStructure

    def __str__(self) -> str:
        return (
            f"{self.model}: {self.parameters} parameters, mean {self.mean_px:.3f} px, held out "
            f"{self.held_out_px:.3f} px, {self.structure}"
        )


@dataclass(frozen=True, slots=True)
class SelectedCalibration:
    """A camera's calibration with the selected model, and the scores of all models that were fitted."""

    calibration: CameraCalibration
    model: Model
    scores: tuple[ModelScore, ...]
    polynomial: OcamCamera | None = None  # the most general polynomial camera that was fitted


def select_calibration(
    views: Sequence[BoardView],
    board: CalibrationBoard,
    size: tuple[int, int],
    choice: ModelChoice = "auto",
    view: View = "mirror",
    shape: PrintShape = AS_DRAWN,
) -> SelectedCalibration:
    """Calibrate a camera with every model of the choice, and select the one with the least held-out error.

    shape: start value of the print's shape, whose free modes are fitted. Models are compared on the views that all of
    them accept. Raises CalibError if no model can be fitted.
    """
    if choice not in MODEL_CHOICES:
        raise CalibError(f"model: expected one of {', '.join(MODEL_CHOICES)}, found {choice!r}")
    good, rejected = consistent_views(views, board, size, view)
    fitted, failures = dict[Model, CameraCalibration](), list[CalibError]()
    ocam: FittedModel | None = None
    for model in FIT_ORDER if choice == "auto" else (choice,):
        try:
            found = fitted[model] = calibrate_consistent(good, rejected, board, size, model, view, ocam, shape)
        except CalibError as error:
            failures.append(error)
            continue
        if model == "ocam" and len(found.views) == len(good):
            ocam = FittedModel(found.camera, found.fit, found.parameters)
    if not fitted:
        raise failures[0]
    common = set.intersection(*({seen.name for seen in found.views} for found in fitted.values()))
    scores = tuple(_score(model, fitted[model], common) for model in MODELS if model in fitted)
    least_px = min(score.held_out_px for score in scores)
    ties = [score for score in scores if score.held_out_px <= (1 + TIE_PART) * least_px]
    best = min(ties, key=lambda score: score.parameters).model
    polynomials = [found.camera for found in fitted.values() if isinstance(found.camera, OcamCamera)]
    return SelectedCalibration(fitted[best], best, scores, polynomials[-1] if polynomials else None)


def refine_selection(
    found: SelectedCalibration, images: Mapping[str, NDArray[np.uint8]], view: View
) -> SelectedCalibration:
    """Refine the corners with the selected camera, and fit its model again; images by the views' names.

    The scores of all models remain those of the selection, before the refinement.
    """
    return replace(found, calibration=refine_camera_calibration(found.calibration, images, found.model, view))


def camera_structure(found: CameraCalibration) -> ResidualStructure:
    """Return the structure of a calibration's residuals."""
    pixels = observations(found.views, found.board).pixels
    return residual_structure(pixels, found.fit.residuals, found.board.points, found.camera.center)


def _score(model: Model, found: CameraCalibration, common: set[str]) -> ModelScore:
    chosen = np.array([seen.name in common for seen in found.views])
    observed = observations(found.views, found.board, found.shape, fixed=True)
    held_out_px = held_out_error_px(found.camera, found.fit.T_cam_board[chosen], observed.select(chosen))
    return ModelScore(model, len(found.parameters), found.fit.mean_px, held_out_px, camera_structure(found))
