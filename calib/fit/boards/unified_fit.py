"""Fit of an `omni` camera to board views: start values from the rays of an `ocam` camera, then bundle adjustment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib import se3
from calib.fit.boards.bundle import BundleResult, Observations, adjust_bundle
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.models.unified import OMNI_NAMES, UnifiedCamera

# Numbers of distortion coefficients that may be solved for, because a lens has none, k1 and k2, or all.
DISTORTION_TERMS = (0, 2, 4)
# Start values of xi, so that pinholes (0), hyperbolic mirrors, parabolic mirrors (1) and fisheye lenses are near one.
START_XI = np.linspace(0.0, 3.0, 31)
# Least cos(angle) + xi at which the projection is well defined: less would be 100 focal lengths from the centre.
MIN_DENOMINATOR = 1e-2
# Number of radii at which profiles are compared: enough for two parameters.
RADII = 60


def fit_unified(observed: Observations, ocam: OcamCamera, T_ocam_board: Array, terms: int = 0) -> BundleResult:
    """Fit a camera to observations, starting from a fitted ocam camera and its poses (K, 4, 4).

    Parameters are read by unified_factory and unified_parameters. terms: number of k1, k2, p1, p2 that are solved for;
    xi, the focal lengths and k1, k2 are strongly correlated. The axes are the unified model's: x, y along u, v (x
    against u in a mirror, fu < 0), z along the ray of the centre.
    """
    T_omni_ocam = unified_from_ocam(ocam)
    xi, focal = _fit_radial_profile(ocam, observed)
    flip = -1.0 if ocam.view == "mirror" else 1.0
    camera = UnifiedCamera(xi, (flip * focal, focal), ocam.center, ocam.size)
    start = np.array([xi, *camera.focal, *camera.center, *[0.0] * terms]) / _conversion(ocam.size, terms)
    return adjust_bundle(unified_factory(ocam.size, terms), start, T_omni_ocam @ T_ocam_board, observed)


def unified_from_ocam(ocam: OcamCamera) -> Array:
    """Return T_omni_ocam (4, 4): from the ocam frame (x down) to the unified one (x right or, in a mirror, left)."""
    flip = -1.0 if ocam.view == "mirror" else 1.0
    return se3.transform(np.array([[0, flip, 0], [1, 0, 0], [0, 0, -flip]]), np.zeros(3))


def _fit_radial_profile(ocam: OcamCamera, observed: Observations) -> tuple[float, float]:
    """Fit xi and focal length [px] of rho = f sin / (cos + xi) to the camera's profile over the boards' radii."""
    reach = np.linalg.norm(observed.pixels - ocam.center, axis=2)
    rho = np.linspace(float(np.nanmin(reach)), float(np.nanmax(reach)), RADII)
    angle = np.arctan2(rho, -ocam.height(rho))
    best = (np.inf, 1.0, 1.0)
    for xi in START_XI:
        low = np.cos(angle) + xi
        if low.min() > MIN_DENOMINATOR:
            m = np.sin(angle) / low
            focal = float(m @ rho / (m @ m))
            best = min(best, (float(np.abs(rho - focal * m).max()), float(xi), focal))
    return best[1], best[2]


def _conversion(size: tuple[int, int], terms: int) -> Array:
    """Return the factors from parameters of about a pixel's effect to the model's own."""
    scale = min(size) / 2
    return np.array([1, scale, scale, scale, scale, *[1.0] * terms]) / scale


def unified_factory(size: tuple[int, int], terms: int = 0) -> Callable[[Array], UnifiedCamera]:
    """Return the function that makes a camera of a vector of parameters."""
    conversion = _conversion(size, terms)

    def camera_of(parameters: Array) -> UnifiedCamera:
        xi, fu, fv, pu, pv, *distortion = (float(value) for value in parameters * conversion)
        k1, k2, p1, p2 = (*distortion, *[0.0] * (4 - terms))
        return UnifiedCamera(xi, (fu, fv), (pu, pv), size, (k1, k2, p1, p2))

    return camera_of


def unified_parameters(fit: BundleResult, size: tuple[int, int], terms: int = 0) -> list[tuple[str, float, float]]:
    """Return name, value and standard deviation of every solved parameter, in the units of the model's file."""
    conversion = _conversion(size, terms)
    sigmas = np.sqrt(np.maximum(0, np.diag(fit.covariance))) * conversion
    return [
        (name, float(value), float(sigma))
        for name, value, sigma in zip(OMNI_NAMES[: 5 + terms], fit.parameters * conversion, sigmas, strict=True)
    ]
