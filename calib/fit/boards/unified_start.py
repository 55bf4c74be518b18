"""Start of a unified camera: from a fitted ocam camera and its poses."""

from __future__ import annotations

import numpy as np

from calib import se3
from calib.fit.boards.bundle import Observations
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.models.unified import UnifiedCamera

# Start values of xi, so that pinholes (0), hyperbolic mirrors, parabolic mirrors (1) and fisheye lenses are near one.
START_XI = np.linspace(0.0, 3.0, 31)
# Least cos(angle) + xi at which the projection is well defined: less would be 100 focal lengths from the centre.
MIN_DENOMINATOR = 1e-2
# Number of radii at which profiles are compared: enough for two parameters.
RADII = 60


def unified_start(ocam: OcamCamera, observed: Observations, T_ocam_board: Array) -> tuple[UnifiedCamera, Array]:
    """Return the unified camera near an ocam camera, without distortion, and the poses (K, 4, 4) of the boards in it.

    The axes are the unified model's: x, y along u, v (x against u in a mirror, fu < 0), z along the ray of the centre.
    """
    xi, focal = _fit_radial_profile(ocam, observed)
    flip = -1.0 if ocam.view == "mirror" else 1.0
    return UnifiedCamera(xi, (flip * focal, focal), ocam.center, ocam.size), unified_from_ocam(ocam) @ T_ocam_board


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
