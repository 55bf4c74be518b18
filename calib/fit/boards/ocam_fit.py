"""Fit of an `ocam` camera to board views: linear solution, then bundle adjustment of intrinsics and poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.errors import CalibError
from calib.fit.boards.bundle import BundleResult, Observations, adjust_bundle
from calib.fit.boards.ocam_linear import powers, solve_linear
from calib.models.camera import Array
from calib.models.ocam import TANGENTIAL_NAMES, OcamCamera, View

# Degree of the polynomial at the start, as in the toolbox.
DEGREE = 4


def fit_ocam(observed: Observations, size: tuple[int, int], view: View = "mirror") -> BundleResult:
    """Fit a camera of degree DEGREE; size (width, height) [px].

    Parameters, read by ocam_factory and ocam_parameters, in pixels at the scale of half the image: a0, a2 ... ; centre
    row, column; c - 1, and d = e, because a rotation of the image about its centre equals one of the camera. Raises
    CalibError if no camera fits.
    """
    linear = solve_linear(observed, size, DEGREE, view)
    if linear.coefficients[0] >= 0:
        raise CalibError(
            "calibrate: no mirror or lens shows boards as in these views; leave out those whose corners "
            "are wrong, and check --corners"
        )
    start = np.concatenate([linear.coefficients, linear.center, (0.0, 0.0)])
    return adjust_bundle(ocam_factory(size, view, DEGREE), start, linear.T_cam_board, observed)


def raise_degree(fit: BundleResult, observed: Observations, camera: OcamCamera) -> BundleResult:
    """Fit a camera with one more power of rho, starting from a fit."""
    degree, tangential = ocam_structure(camera)
    count = len(powers(degree))
    start = np.concatenate([fit.parameters[:count], [0.0], fit.parameters[count:]])
    factory = ocam_factory(camera.size, camera.view, degree + 1, tangential=tangential)
    return adjust_bundle(factory, start, fit.T_cam_board, observed)


def add_tangential(fit: BundleResult, observed: Observations, camera: OcamCamera) -> BundleResult:
    """Fit a camera with tangential terms, starting from a fit without them."""
    degree, _ = ocam_structure(camera)
    start = np.concatenate([fit.parameters, np.zeros(len(TANGENTIAL_NAMES))])
    factory = ocam_factory(camera.size, camera.view, degree, tangential=True)
    return adjust_bundle(factory, start, fit.T_cam_board, observed)


def ocam_structure(camera: OcamCamera) -> tuple[int, bool]:
    """Return the degree of a camera's polynomial, and True if it has tangential terms."""
    return len(camera.polynomial) - 1, any(camera.tangential)


def ocam_factory(
    size: tuple[int, int], view: View, degree: int = DEGREE, *, tangential: bool = False
) -> Callable[[Array], OcamCamera]:
    """Return the function that makes a camera of a vector of parameters."""
    conversion, count = _conversion(size, degree, tangential), len(powers(degree))

    def make(parameters: Array) -> OcamCamera:
        values = parameters * conversion
        a0, *others = values[:count]
        row, column, stretch, skew = values[count : count + 4]
        p1, p2 = (float(value) for value in values[count + 4 :]) if tangential else (0.0, 0.0)
        return OcamCamera((a0, 0.0, *others), (row, column), (1 + stretch, skew, skew), size, view, (p1, p2))

    return make


def _conversion(size: tuple[int, int], degree: int, tangential: bool) -> Array:
    """Return the factors from scaled parameters to the model's own."""
    scale = min(size) / 2
    decentring = np.full(len(TANGENTIAL_NAMES), scale**-2) if tangential else np.zeros(0)
    return np.concatenate([scale ** -powers(degree).astype(float), (1, 1), (1 / scale, 1 / scale), decentring])


def ocam_parameters(
    fit: BundleResult, size: tuple[int, int], degree: int = DEGREE, *, tangential: bool = False
) -> list[tuple[str, float, float]]:
    """Return name, value and standard deviation of every parameter, in the units of the model's file."""
    conversion = _conversion(size, degree, tangential)
    names = [f"a{power}" for power in powers(degree)] + ["center_row", "center_column", "c", "d = e"]
    names += TANGENTIAL_NAMES if tangential else ()
    values = fit.parameters * conversion + np.where([name == "c" for name in names], 1.0, 0.0)
    sigmas = np.sqrt(np.maximum(0, np.diag(fit.covariance))) * conversion
    return [(name, float(value), float(sigma)) for name, value, sigma in zip(names, values, sigmas, strict=True)]
