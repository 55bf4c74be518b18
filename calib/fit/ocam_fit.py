"""The `ocam` camera that fits boards: linear solution, then bundle adjustment over everything."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.errors import CalibError
from calib.fit.bundle import Adjusted, Observed, adjust
from calib.fit.ocam_linear import powers, solve_linear
from calib.models.camera import Array
from calib.models.ocam import OcamCamera, View

DEGREE = 4


def fit_ocam(observed: Observed, size: tuple[int, int], view: View = "mirror") -> Adjusted:
    """The adjusted camera of degree DEGREE, read by ocam_maker and ocam_values; size (width, height) [px].

    Parameters, all in pixels at the scale of half the image: a0, a2 ... ; centre row, column; c - 1, and d = e, as a
    turn of the image about its centre cannot be told from one of the camera. CalibError where nothing fits.
    """
    linear = solve_linear(observed, size, DEGREE, view)
    if linear.coefficients[0] >= 0:
        raise CalibError("calibrate: no mirror or lens shows boards as in these views; leave out those whose corners "
                         "are wrong, and check --corners")
    start = np.concatenate([linear.coefficients, linear.center, (0.0, 0.0)])
    return adjust(ocam_maker(size, view, DEGREE), start, linear.T_cam_board, observed)


def raise_degree(fit: Adjusted, observed: Observed, camera: OcamCamera) -> Adjusted:
    """The fit of a camera with one more power of rho."""
    start = np.concatenate([fit.parameters[:-4], [0.0], fit.parameters[-4:]])
    degree = len(fit.parameters) - 4 + 1
    return adjust(ocam_maker(camera.size, camera.view, degree), start, fit.T_cam_board, observed)


def ocam_maker(size: tuple[int, int], view: View, degree: int = DEGREE) -> Callable[[Array], OcamCamera]:
    """The camera of a vector of parameters."""
    conversion = _conversion(size, degree)

    def make(parameters: Array) -> OcamCamera:
        values = parameters * conversion
        a0, *others = values[:-4]
        row, column, stretch, skew = values[-4:]
        return OcamCamera((a0, 0.0, *others), (row, column), (1 + stretch, skew, skew), size, view)

    return make


def _conversion(size: tuple[int, int], degree: int) -> Array:
    """What turns the scaled parameters into the model's own."""
    scale = min(size) / 2
    return np.concatenate([scale ** -powers(degree).astype(float), (1, 1), (1 / scale, 1 / scale)])


def ocam_values(fit: Adjusted, size: tuple[int, int], degree: int = DEGREE) -> list[tuple[str, float, float]]:
    """Name, value and standard deviation of every parameter as the model's file has them."""
    conversion = _conversion(size, degree)
    names = [f"a{power}" for power in powers(degree)] + ["center_row", "center_column", "c", "d = e"]
    values = fit.parameters * conversion + np.where([name == "c" for name in names], 1.0, 0.0)
    deviations = np.sqrt(np.maximum(0, np.diag(fit.covariance))) * conversion
    return [(name, float(value), float(deviation))
            for name, value, deviation in zip(names, values, deviations, strict=True)]
