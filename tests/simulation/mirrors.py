"""Ray-traced mirror cameras: an orthographic camera below a quadric mirror, by the law of reflection.

The ground truth of calibrations: no camera model is used. A tilted camera, and a mirror that is not a paraboloid about
the camera's axis, are not central: every pixel has a ray of its own that starts on the mirror.

Camera frame: origin at the focus of the nominal paraboloid, z down along the mirror's axis, x and y as in the unified
model (u = fu * x / h + pu on the nominal mirror, fu < 0). With w = h / 2 - z, the height above the mirror's vertex, the
surface is x^2 (1 + e)^2 + y^2 = 2 h w - (1 + k) w^2, where k = -1 is the paraboloid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.models.camera import Array

# Distance below the focus from which the camera's parallel rays start.
START_M = 1.0
# Newton iterations of the projection, step of its derivatives, and its tolerance.
PROJECT_STEPS, DIFFERENCE_PX, TOLERANCE = 12, 0.01, 1e-9


@dataclass(frozen=True, slots=True)
class MirrorCamera:
    """An orthographic camera that looks up at a convex mirror with focal parameter parameter_m (radius of the horizon).

    tilt_rad: rotation of the camera about x and y, relative to the mirror; conic 1 + k and ellipticity e: deviation of
    the mirror from the paraboloid. horizon_px: radius of the horizon of the nominal mirror.
    """

    horizon_px: float
    center: tuple[float, float]
    size: tuple[int, int]
    parameter_m: float = 0.03
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    conic: float = 0.0
    ellipticity: float = 0.0

    def rays(self, pixels: Array) -> tuple[Array, Array]:
        """Return origins (N, 3) [m] on the mirror and unit directions (N, 3) of pixels (N, 2); NaN off the mirror."""
        scale = self.parameter_m / self.horizon_px
        x, y = -(pixels[:, 0] - self.center[0]) * scale, (pixels[:, 1] - self.center[1]) * scale
        R = se3.rotation_exp([*self.tilt_rad, 0.0])
        start = np.column_stack([x, y, np.full(len(x), START_M)]) @ R.T
        beam = -R[:, 2]
        origin = start + self._distance(start, beam)[:, None] * beam
        normal = self._normal(origin)
        return origin, beam - 2 * (normal @ beam)[:, None] * normal

    def lift(self, pixels: Array) -> Array:
        """Return unit ray directions (N, 3) of pixels (N, 2)."""
        return self.rays(np.asarray(pixels, float))[1]

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) [m], by Newton steps on the ray that passes through the point."""
        points = np.asarray(points, float)
        unit = points / np.linalg.norm(points, axis=1, keepdims=True)
        nominal = unit[:, :2] / (1 + unit[:, 2:])
        pixels = np.asarray(self.center) + self.horizon_px * nominal * (-1, 1)
        for _ in range(PROJECT_STEPS):
            error = self._miss(pixels, points)
            columns = [
                (self._miss(pixels + step, points) - self._miss(pixels - step, points)) / (2 * DIFFERENCE_PX)
                for step in DIFFERENCE_PX * np.eye(2)
            ]
            J = np.stack(columns, axis=-1)
            step = np.einsum("nij,nj->ni", np.linalg.pinv(np.nan_to_num(J)), error)
            pixels = pixels - step
            if np.nanmax(np.abs(step), initial=0.0) < TOLERANCE:
                break
        return np.asarray(pixels)

    def _miss(self, pixels: Array, points: Array) -> Array:
        """Return the difference (N, 3) of the pixels' ray directions and the directions from the mirror to points."""
        origin, direction = self.rays(pixels)
        wanted = points - origin
        return np.asarray(direction - wanted / np.linalg.norm(wanted, axis=1, keepdims=True))

    def _distance(self, start: Array, beam: Array) -> Array:
        """Return the distance (N,) along the beam to the first point of the mirror."""
        h, stretch = self.parameter_m, np.array([1 + self.ellipticity, 1.0])
        across, rise = beam[:2] * stretch, -beam[2]
        xy, w = start[:, :2] * stretch, h / 2 - start[:, 2]
        a = across @ across + self.conic * rise * rise
        b = 2 * (xy @ across) - 2 * h * rise + 2 * self.conic * w * rise
        c = (xy**2).sum(axis=1) - 2 * h * w + self.conic * w * w
        root = b * b - 4 * a * c
        return np.asarray(2 * c / (-b + np.sqrt(np.where(root >= 0, root, np.nan))))

    def _normal(self, origin: Array) -> Array:
        """Return the unit normals (N, 3) of the mirror."""
        w = self.parameter_m / 2 - origin[:, 2]
        gradient = np.column_stack(
            [(1 + self.ellipticity) ** 2 * origin[:, 0], origin[:, 1], self.parameter_m - self.conic * w]
        )
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))
