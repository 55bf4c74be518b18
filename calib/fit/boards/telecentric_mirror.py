"""A camera whose wavefront and image have one cause: the shape and tilt of a paraboloid below a telecentric lens.

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

from dataclasses import dataclass, replace

import numpy as np

from calib.errors import CalibError
from calib.fit.parameterisation import CameraParameterisation, parameterise
from calib.models.camera import Array, OmniCamera
from calib.models.derivatives import pixel_derivatives
from calib.models.ocam import OcamCamera
from calib.models.wavefront import TERMS, WAVEFRONT_NAMES

# Prior of h: two of three mirrors are between 14 and 46 mm, because mirrors are 5 to 20 cm wide. With 15 or 50 mm as
# its median the lengths of ten rigs change by less than 0.01 %.
RADIUS_NAME, RADIUS_M, RADIUS_LOG_SIGMA = "mirror_radius", 0.025, 0.6
# Prior of what the wavefront differs from the mirror's, in parts of h, because there are pixels that are not square by
# a thousandth (w_a, w_b), a mirror whose own coma is that of a tilt by 0.06 degree (w_x, w_y), a lens that distorts its
# rim by a thousandth (w_s).
DEVIATIONS = np.array([5e-4, 5e-4, 1e-3, 1e-3, 3.5e-4])
# Step of the derivatives [units], because the plain values are nearly linear over it, and 1e9 times their rounding.
STEP = 1e-4


@dataclass(frozen=True, slots=True)
class TelecentricMirror:
    """Parameterisation like CameraParameterisation, with steps of the wavefront's deviations and of log h instead.

    The last steps, of RADIUS_NAME and the wavefront, have the standard deviation 1 before the fit.
    """

    plain: CameraParameterisation
    start: Array  # (P,)

    @staticmethod
    def about(camera: OmniCamera) -> TelecentricMirror:
        """Return the parameterisation about a camera, whose wavefront is its start; CalibError if it sees no mirror."""
        if not isinstance(camera, OcamCamera) or camera.view != "mirror":
            raise CalibError("calibrate: expected an ocam camera below a mirror")
        plain = parameterise(camera, wavefront=True)
        deviations = (np.array(camera.wavefront) / RADIUS_M - wavefront_parts(camera)) / DEVIATIONS
        return TelecentricMirror(plain, np.concatenate([plain.start[:-TERMS], deviations, [0.0]]))

    @property
    def base(self) -> OmniCamera:
        """Return the camera at the start."""
        return self.plain.base

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names (P,) of the steps, of which the radius is no plain value."""
        return (*self.plain.names, RADIUS_NAME)

    @property
    def units(self) -> Array:
        """Return one step (P,) of every parameter."""
        return np.concatenate([self.plain.units[:-TERMS], np.ones(TERMS + 1)])

    def camera_at(self, steps: Array) -> OmniCamera:
        """Return the camera at the steps (P,); raises CalibError if its parameters are not those of a camera."""
        camera = self.plain.camera_at(np.concatenate([steps[: -TERMS - 1], np.zeros(TERMS)]))
        assert isinstance(camera, OcamCamera)
        values = self.start + steps * self.units
        parts = wavefront_parts(camera) + DEVIATIONS * values[-TERMS - 1 : -1]
        radius_m = RADIUS_M * float(np.exp(RADIUS_LOG_SIGMA * values[-1]))
        return replace(camera, wavefront=tuple((radius_m * parts).tolist()))

    def derivatives(self, steps: Array, points: Array) -> tuple[Array, Array]:
        """Return the derivatives of the camera's pixels by points (N, 3), (N, 2, 3), and by the steps, (N, 2, P)."""
        by_point, by_plain = pixel_derivatives(self.camera_at(steps), points, self.plain.names)
        return by_point, by_plain @ self.plain_by_steps(steps)

    def plain_values(self, steps: Array) -> Array:
        """Return the parameters of `plain` at the steps, without the radius, in their own units."""
        camera = self.camera_at(steps)
        assert isinstance(camera, OcamCamera)
        kept = self.plain.start + self.plain.units * np.concatenate([steps[: -TERMS - 1], np.zeros(TERMS)])
        return np.concatenate([kept[:-TERMS], camera.wavefront])

    def plain_by_steps(self, steps: Array) -> Array:
        """Return the derivatives (P - 1, P) of the plain values by the steps."""
        return np.stack(
            [
                (self.plain_values(steps + step) - self.plain_values(steps - step)) / (2 * STEP)
                for step in STEP * np.eye(len(steps))
            ],
            axis=-1,
        )


def wavefront_parts(camera: OcamCamera) -> Array:
    """Return the wavefront (TERMS,) of the mirror that explains a camera's image, in parts of h."""
    (c, d, e), (p1, p2) = camera.affine, camera.tangential
    a0, a4 = abs(camera.polynomial[0]), (*camera.polynomial, *np.zeros(4))[4]
    by_name = {"w_a": (c - 1) / 2, "w_b": d + e, "w_x": 4 * a0 * p2, "w_y": 4 * a0 * p1, "w_s": -8 * a0**3 * a4}
    return np.array([by_name[name] for name in WAVEFRONT_NAMES], float)
