"""Fit of each camera model to observed corners, with the choice of its number of terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from calib.fit.boards.bundle import BundleResult, Observations
from calib.fit.boards.cross_validation import held_out_error_px
from calib.fit.boards.ocam_fit import (
    DEGREE,
    add_tangential,
    fit_ocam,
    ocam_factory,
    ocam_parameters,
    ocam_structure,
    raise_degree,
)
from calib.fit.boards.unified_fit import DISTORTION_TERMS, fit_unified, unified_factory, unified_parameters
from calib.models.camera import OmniCamera
from calib.models.ocam import OcamCamera, View

# In ascending order of the number of parameters. A more general model is one more entry here and in fit_model.
Model = Literal["omni", "ocam", "ocam_tangential"]
MODELS: tuple[Model, ...] = ("omni", "ocam", "ocam_tangential")
# A further term is used if it reduces the error by this part, because a smaller gain may come from a mirror that
# is not quite central, and then bends rays by tenths of a degree.
MIN_IMPROVEMENT = 0.1
# Degrees tried above DEGREE: higher ones would bend the profile between the radii of the corners.
HIGHER_DEGREES = (5, 6)
# A tangential camera of degree 5 is used if its held-out error is lower by this part than that of degree 4.
MIN_HELD_OUT_IMPROVEMENT = 0.01


@dataclass(frozen=True, slots=True)
class FittedModel:
    """A fitted camera: fit has the poses and residuals of the views."""

    camera: OmniCamera
    fit: BundleResult
    parameters: tuple[tuple[str, float, float], ...]  # name, value, standard deviation


def fit_model(
    model: Model, observed: Observations, size: tuple[int, int], view: View, ocam: FittedModel | None = None
) -> FittedModel:
    """Fit the camera of a model.

    All models start from an ocam camera of degree DEGREE, which has a linear initialisation; ocam: the one fitted to
    the same observations, if it is known, of any degree.
    """
    match model:
        case "omni":
            return _fit_omni(observed, ocam or _first_ocam(observed, size, view))
        case "ocam":
            return _with_best_degree(observed, _first_ocam(observed, size, view))
        case "ocam_tangential":
            has_start = ocam is not None and ocam_structure(_ocam(ocam)) == (DEGREE, False)
            return _fit_tangential(observed, ocam if ocam and has_start else _first_ocam(observed, size, view))


def _first_ocam(observed: Observations, size: tuple[int, int], view: View) -> FittedModel:
    first = fit_ocam(observed, size, view)
    return _fitted_ocam(first, ocam_factory(size, view)(first.parameters))


def _with_best_degree(observed: Observations, ocam: FittedModel) -> FittedModel:
    """Return the ocam camera of the lowest degree that no higher one improves significantly."""
    best = trial = ocam
    for _ in HIGHER_DEGREES:
        trial = _with_higher_degree(observed, trial)
        best = trial if _is_significantly_better(best.fit, trial.fit) else best
    return best


def _with_higher_degree(observed: Observations, ocam: FittedModel) -> FittedModel:
    camera = _ocam(ocam)
    degree, tangential = ocam_structure(camera)
    fit = raise_degree(ocam.fit, observed, camera)
    factory = ocam_factory(camera.size, camera.view, degree + 1, tangential=tangential)
    return _fitted_ocam(fit, factory(fit.parameters))


def _fit_tangential(observed: Observations, ocam: FittedModel) -> FittedModel:
    """Fit tangential terms to a camera of degree 4, and choose degree 4 or 5 by the held-out error."""
    camera = _ocam(ocam)
    fit = add_tangential(ocam.fit, observed, camera)
    degree, _ = ocam_structure(camera)
    low = _fitted_ocam(fit, ocam_factory(camera.size, camera.view, degree, tangential=True)(fit.parameters))
    high = _with_higher_degree(observed, low)
    low_px, high_px = (held_out_error_px(one.camera, one.fit.T_cam_board, observed) for one in (low, high))
    return high if high_px < (1 - MIN_HELD_OUT_IMPROVEMENT) * low_px else low


def _fitted_ocam(fit: BundleResult, camera: OcamCamera) -> FittedModel:
    degree = len(camera.polynomial) - 1
    tangential = len(fit.parameters) > degree + 4
    return FittedModel(camera, fit, tuple(ocam_parameters(fit, camera.size, degree, tangential=tangential)))


def _ocam(fitted: FittedModel) -> OcamCamera:
    assert isinstance(fitted.camera, OcamCamera)
    return fitted.camera


def _fit_omni(observed: Observations, ocam: FittedModel) -> FittedModel:
    """Fit omni cameras, and return the one with the fewest distortion terms that more do not improve significantly."""
    start = _ocam(ocam)
    best, terms = fit_unified(observed, start, ocam.fit.T_cam_board, 0), 0
    for more in DISTORTION_TERMS[1:]:
        trial = fit_unified(observed, start, ocam.fit.T_cam_board, more)
        if _is_significantly_better(best, trial):
            best, terms = trial, more
    camera = unified_factory(start.size, terms)(best.parameters)
    return FittedModel(camera, best, tuple(unified_parameters(best, start.size, terms)))


def _is_significantly_better(best: BundleResult, trial: BundleResult) -> bool:
    return trial.mean_px < (1 - MIN_IMPROVEMENT) * best.mean_px
