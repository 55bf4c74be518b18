"""Fit of each camera model to observed corners, with the choice of its number of terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.errors import CalibError
from calib.fit.boards.bundle import BundleResult, Observations, adjust_bundle
from calib.fit.boards.cross_validation import held_out_error_px
from calib.fit.boards.ocam_linear import powers, solve_linear
from calib.fit.boards.unified_start import unified_start
from calib.fit.parameterisation import OCAM_NAMES, with_names
from calib.models.camera import Array, OmniCamera
from calib.models.ocam import TANGENTIAL_NAMES, OcamCamera, View
from calib.models.unified import OMNI_NAMES, UnifiedCamera

# In ascending order of the number of parameters. A more general model is one more entry here and in fit_model.
Model = Literal["omni", "ocam", "ocam_tangential"]
MODELS: tuple[Model, ...] = ("omni", "ocam", "ocam_tangential")
# Degree of the polynomial at the start, as in the toolbox. Higher ones than HIGHER_DEGREES would bend the profile
# between the radii of the corners.
DEGREE = 4
HIGHER_DEGREES = (5, 6)
# Numbers of distortion terms that an omni camera may have: none, k1 k2, and p1 p2 as well.
DISTORTION_TERMS = (0, 2, 4)
# A further term is used if it reduces the error by this part, because a smaller gain may come from a mirror that
# is not quite central, and then bends rays by tenths of a degree.
MIN_IMPROVEMENT = 0.1
# A tangential camera of degree 5 is used if its held-out error is lower by this part than that of degree 4.
MIN_HELD_OUT_IMPROVEMENT = 0.01


@dataclass(frozen=True, slots=True)
class FittedModel:
    """A fitted camera: fit has the poses and residuals of the views."""

    camera: OmniCamera
    fit: BundleResult
    parameters: tuple[tuple[str, float, float], ...]  # name, value, standard deviation

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(name for name, _, _ in self.parameters)


def fit_model(
    model: Model, observed: Observations, size: tuple[int, int], view: View, ocam: FittedModel | None = None
) -> FittedModel:
    """Fit the camera of a model.

    All models start from an ocam camera of degree DEGREE, which has a linear initialisation; ocam: the one fitted to
    the same observations, if it is known, of any degree.
    """
    match model:
        case "omni":
            return _fit_omni(observed, ocam or fit_ocam(observed, size, view))
        case "ocam":
            return _with_best_degree(observed, fit_ocam(observed, size, view))
        case "ocam_tangential":
            has_start = ocam is not None and ocam.names == ocam_names(DEGREE)
            return _fit_tangential(observed, ocam if ocam and has_start else fit_ocam(observed, size, view))


def ocam_names(degree: int) -> tuple[str, ...]:
    """Return the parameters of an ocam camera without tangential terms: a0, a2 ..., centre and affine."""
    return (*(f"a{power}" for power in powers(degree)), *OCAM_NAMES)


def fit_ocam(observed: Observations, size: tuple[int, int], view: View = "mirror") -> FittedModel:
    """Fit an ocam camera of degree DEGREE; size (width, height) [px]. CalibError if no camera fits."""
    linear = solve_linear(observed, size, DEGREE, view)
    if linear.coefficients[0] >= 0:
        raise CalibError(
            "calibrate: no mirror or lens shows boards as in these views; leave out those whose corners "
            "are wrong, and check --corners"
        )
    polynomial = np.zeros(DEGREE + 1)
    polynomial[powers(DEGREE)] = linear.coefficients / linear.scale_px ** powers(DEGREE).astype(float)
    camera = OcamCamera(tuple(polynomial.tolist()), linear.center, (1.0, 0.0, 0.0), size, view)
    return refit(camera, ocam_names(DEGREE), linear.T_cam_board, observed)


def refit(camera: OmniCamera, names: Sequence[str], T_cam_board: Array, observed: Observations) -> FittedModel:
    """Fit the named parameters of a camera and the poses (K, 4, 4), from their start values."""
    assert isinstance(camera, OcamCamera | UnifiedCamera)
    parameters = with_names(camera, names)
    fit = adjust_bundle(parameters, T_cam_board, observed)
    values = parameters.plain_values(fit.parameters)
    sigmas = np.sqrt(np.maximum(0, np.diag(fit.covariance))) * parameters.units
    named = zip(parameters.names, values.tolist(), sigmas.tolist(), strict=True)
    return FittedModel(parameters.camera_at(fit.parameters), fit, tuple(named))


def _with_best_degree(observed: Observations, ocam: FittedModel) -> FittedModel:
    """Return the ocam camera of the lowest degree that no higher one improves significantly."""
    best = trial = ocam
    for degree in HIGHER_DEGREES:
        trial = refit(_ocam(trial), ocam_names(degree), trial.fit.T_cam_board, observed)
        best = trial if _is_significantly_better(best.fit, trial.fit) else best
    return best


def _fit_tangential(observed: Observations, ocam: FittedModel) -> FittedModel:
    """Fit tangential terms to a camera of degree 4, and choose degree 4 or 5 by the held-out error."""
    low = refit(_ocam(ocam), (*ocam_names(DEGREE), *TANGENTIAL_NAMES), ocam.fit.T_cam_board, observed)
    high = refit(_ocam(low), (*ocam_names(DEGREE + 1), *TANGENTIAL_NAMES), low.fit.T_cam_board, observed)
    low_px, high_px = (held_out_error_px(one.camera, one.fit.T_cam_board, observed) for one in (low, high))
    return high if high_px < (1 - MIN_HELD_OUT_IMPROVEMENT) * low_px else low


def _ocam(fitted: FittedModel) -> OcamCamera:
    assert isinstance(fitted.camera, OcamCamera)
    return fitted.camera


def _fit_omni(observed: Observations, ocam: FittedModel) -> FittedModel:
    """Fit omni cameras, and return the one with the fewest distortion terms that more do not improve significantly."""
    camera, T_cam_board = unified_start(_ocam(ocam), observed, ocam.fit.T_cam_board)
    best = refit(camera, OMNI_NAMES[: 5 + DISTORTION_TERMS[0]], T_cam_board, observed)
    trial = best
    for more in DISTORTION_TERMS[1:]:
        trial = refit(trial.camera, OMNI_NAMES[: 5 + more], trial.fit.T_cam_board, observed)
        best = trial if _is_significantly_better(best.fit, trial.fit) else best
    return best


def _is_significantly_better(best: BundleResult, trial: BundleResult) -> bool:
    return trial.mean_px < (1 - MIN_IMPROVEMENT) * best.mean_px
