"""Prior of the wavefront of a camera below a mirror: free, or that of a paraboloid below a telecentric lens.

A camera along parallel rays sees by the mirror z = rho^2 / (2 h) the stereographic image rho = h m of directions m
(calib/models/wavefront.py). To first order a mirror that is higher by g(rho) moves the image by -h grad g, and
lengthens the light's way by 2 q g, which is the support function of its wavefront. A camera tilted by t below the
mirror moves the image by h t m^2, and its wavefront is h t m. So, with the terms of calib/models/ocam.py,

    spherical aberration   w_s = -8 |a0|^3 a4 h          (g = rho^4)
    astigmatism            w_a = (c - 1) h / 2,   w_b = (d + e) h      (g = x^2 - y^2, x y)
    coma                   w_x = 4 |a0| p2 h,     w_y = 4 |a0| p1 h    (t)

up to lower terms, which only move the viewpoint. Boards show w_s and a4 only together: apart they are the largest
uncertainty of lengths. The radius h of the horizon on the mirror [m] is unknown too; coma and astigmatism show it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.fit.parameters import WAVEFRONT_UNIT_M
from calib.models.camera import Array
from calib.models.wavefront import WAVEFRONT_NAMES

# Prior of h: two of three mirrors are between 14 and 46 mm, because mirrors are 5 to 20 cm wide. With 15 or 50 mm as
# its median the lengths of ten rigs change by less than 0.01 %.
RADIUS_M, RADIUS_LOG_SIGMA = 0.025, 0.6
# Prior of what the wavefront differs from the mirror's, in parts of h, because there are pixels that are not square by
# a thousandth (w_a, w_b), a mirror whose own coma is that of a tilt by 0.06 degree (w_x, w_y), a lens that distorts its
# rim by a thousandth (w_s).
DEVIATIONS = np.array([5e-4, 5e-4, 1e-3, 1e-3, 3.5e-4])


def mirror_residuals(values: Mapping[str, float], log_radius: float, *, telecentric: bool) -> Array:
    """Return how far a wavefront is from the expected one, and the mirror's radius from the usual one, in sigmas (6,).

    values: all parameters of an ocam camera by name. log_radius: log(h / RADIUS_M) / RADIUS_LOG_SIGMA. Where the camera
    is not telecentric, the wavefront is expected to be 0 within a step, and the radius has no meaning.
    """
    wavefront = np.array([values[name] for name in WAVEFRONT_NAMES])
    if not telecentric:
        return np.array([*(wavefront / WAVEFRONT_UNIT_M), log_radius])
    radius_m = RADIUS_M * float(np.exp(RADIUS_LOG_SIGMA * log_radius))
    a0 = abs(values["a0"])
    expected = {
        "w_a": (values["c"] - 1) / 2,
        "w_b": values["d"] + values["e"],
        "w_x": 4 * a0 * values["p2"],
        "w_y": 4 * a0 * values["p1"],
        "w_s": -8 * a0**3 * values.get("a4", 0.0),
    }
    off = wavefront / radius_m - np.array([expected[name] for name in WAVEFRONT_NAMES])
    return np.array([*(off / DEVIATIONS), log_radius])
