"""Fit of an `ocam` camera to board views: linear solution, then bundle adjustment of intrinsics and poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.errors import CalibError
from calib.fit.bundle import BundleResult, Observations, adjust_bundle
from calib.fit.ocam_linear import powers, solve_linear
from calib.models.camera import Array
from calib.models.ocam import OcamCamera, View

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
        raise CalibError("calibrate: no mirror or lens shows boards as in these views; leave out those whose corners "
                         "are wrong, and check --corners")
    start = np.concatenate([linear.coefficients, linear.center, (0.0, 0.0)])
    return adjust_bundle(ocam_factory(size, view, DEGREE), start, linear.T_cam_board, observed)


def raise_degree(fit: BundleResult, observed: Observations, camera: OcamCamera) -> BundleResult:
    """Fit a camera with one more power of rho, starting from a fit."""
    start = np.concatenate([fit.parameters[:-4], [0.0], fit.parameters[-4:]])
    degree = len(fit.parameters) - 4 + 1
    return adjust_bundle(ocam_factory(camera.size, camera.view, degree), start, fit.T_cam_board, observed)


def ocam_factory(size: tuple[int, int], view: View, degree: int = DEGREE) -> Callable[[Array], OcamCamera]:
    """Return the function that makes a camera of a vector of parameters."""
    conversion = _conversion(size, degree)

    def camera_of(parameters: Array) -> OcamCamera:
        values = parameters * conversion
        a0, *others = values[:-4]
        row, column, stretch, skew = values[-4:]
        return OcamCamera((a0, 0.0, *others), (row, column), (1 + stretch, skew, skew), size, view)

    return camera_of


def _conversion(size: tuple[int, int], degree: int) -> Array:
    """Return the factors from scaled parameters to the model's own."""
    scale = min(size) / 2
    return np.concatenate([scale ** -powers(degree).astype(float), (1, 1), (1 / scale, 1 / scale)])


def ocam_parameters(fit: BundleResult, size: tuple[int, int], degree: int = DEGREE) -> list[tuple[str, float, float]]:
    """Return name, value and standard deviation of every parameter, in the units of the model's file."""
    conversion = _conversion(size, degree)
    names = [f"a{power}" for power in powers(degree)] + ["center_row", "center_column", "c", "d = e"]
    values = fit.parameters * conversion + np.where([name == "c" for name in names], 1.0, 0.0)
    sigmas = np.sqrt(np.maximum(0, np.diag(fit.covariance))) * conversion
    return [(name, float(value), float(sigma)) for name, value, sigma in zip(names, values, sigmas, strict=True)]
