"""The `omni` camera that fits boards: from the rays of a fitted `ocam` camera, then bundle adjustment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib import se3
from calib.fit.bundle import Adjusted, Observed, adjust
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

# How many of the distortion's numbers may be solved for: none, k1 and k2, all.
TERMS = (0, 2, 4)
NAMES = ("xi", "fu", "fv", "pu", "pv", "k1", "k2", "p1", "p2")
# Where the search for xi starts: pinhole, hyperbolic mirrors, parabola, fisheye lenses.
START_XI = np.linspace(0.0, 3.0, 31)
RADII = 60


def fit_unified(observed: Observed, ocam: OcamCamera, T_ocam_board: Array, terms: int = 0) -> Adjusted:
    """The adjusted camera, whose parameters unified_maker and unified_values read, from a fitted ocam camera and poses.

    terms: how many of k1, k2, p1, p2 are solved for; xi, the focal lengths and k1, k2 do nearly the same.
    The axes are the unified model's: x, y along u, v (x against u in a mirror, fu < 0), z along the ray of the centre.
    """
    T_omni_ocam = axes(ocam)
    xi, focal = _profile(ocam, observed)
    flip = -1.0 if ocam.view == "mirror" else 1.0
    camera = UnifiedCamera(xi, (flip * focal, focal), ocam.center, ocam.size)
    start = np.array([xi, *camera.focal, *camera.center, *[0.0] * terms]) / _conversion(ocam.size, terms)
    return adjust(unified_maker(ocam.size, terms), start, T_omni_ocam @ T_ocam_board, observed)


def axes(ocam: OcamCamera) -> Array:
    """T_omni_ocam (4, 4): the turn from the ocam frame (x down) to the unified one (x right or, in a mirror, left)."""
    flip = -1.0 if ocam.view == "mirror" else 1.0
    return se3.transform(np.array([[0, flip, 0], [1, 0, 0], [0, 0, -flip]]), np.zeros(3))


def _profile(ocam: OcamCamera, observed: Observed) -> tuple[float, float]:
    """xi and focal length [px] of rho = f sin / (cos + xi) nearest the camera's profile where the boards were."""
    reach = np.linalg.norm(observed.pixels - ocam.center, axis=2)
    rho = np.linspace(float(np.nanmin(reach)), float(np.nanmax(reach)), RADII)
    angle = np.arctan2(rho, -ocam.height(rho))
    best = (np.inf, 1.0, 1.0)
    for xi in START_XI:
        low = np.cos(angle) + xi
        if low.min() > 1e-2:
            m = np.sin(angle) / low
            focal = float(m @ rho / (m @ m))
            best = min(best, (float(np.abs(rho - focal * m).max()), float(xi), focal))
    return best[1], best[2]


def _conversion(size: tuple[int, int], terms: int) -> Array:
    """What turns parameters of a pixel's effect each into the model's own."""
    scale = min(size) / 2
    return np.array([1, scale, scale, scale, scale, *[1.0] * terms]) / scale


def unified_maker(size: tuple[int, int], terms: int = 0) -> Callable[[Array], UnifiedCamera]:
    """The camera of a vector of parameters."""
    conversion = _conversion(size, terms)

    def make(parameters: Array) -> UnifiedCamera:
        xi, fu, fv, pu, pv, *bent = (float(value) for value in parameters * conversion)
        k1, k2, p1, p2 = (*bent, *[0.0] * (4 - terms))
        return UnifiedCamera(xi, (fu, fv), (pu, pv), size, (k1, k2, p1, p2))

    return make


def unified_values(fit: Adjusted, size: tuple[int, int], terms: int = 0) -> list[tuple[str, float, float]]:
    """Name, value and standard deviation of every solved parameter as the model's file has them."""
    conversion = _conversion(size, terms)
    deviations = np.sqrt(np.maximum(0, np.diag(fit.covariance))) * conversion
    return [(name, float(value), float(deviation))
            for name, value, deviation in zip(NAMES[:5 + terms], fit.parameters * conversion, deviations, strict=True)]
