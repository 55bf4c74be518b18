"""The unified model (Geyer and Daniilidis 2000; Mei and Rives 2007) for central mirrors, with the mirror parameter xi.

A unit ray (x, y, z) is projected from a point xi above the sphere's centre, m = (x, y) / (z + xi), then distorted and
scaled: u = fu * mx + pu, v = fv * my + pv. xi = 0 is the pinhole, xi = 1 the parabolic mirror under an orthographic
camera. fu < 0 is the mirror's flip. Points beyond the radius at which the distortion turns back have no image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.camera import Array, undistorted

DISTORTION_NAMES = ("k1", "k2", "p1", "p2")  # as files and results name them


@dataclass(frozen=True, slots=True)
class UnifiedCamera:
    """Unified model `omni`: xi, focal lengths (fu, fv) [px], centre (pu, pv) [px], k1 k2 p1 p2 (Kalibr's radtan)."""

    xi: float
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        values = (self.xi, *self.focal, *self.center, *self.distortion)
        if not np.isfinite(values).all():
            raise CalibError(f"omni camera: every parameter must be a finite number, found {values}")
        if not self.xi > -1 or 0 in self.focal or min(self.size) < 1:
            raise CalibError(
                f"omni camera: expected xi > -1, fu and fv not 0 and a size, found xi {self.xi}, "
                f"focal {self.focal}, size {self.size}"
            )

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN beyond the projection's edge. Mei and Rives 2007, eq. (1), (4)."""
        norm = np.sqrt(np.add.reduce(points * points, axis=1))
        z = points[:, 2] / np.where(norm > 0, norm, np.nan)
        # Beyond this plane two rays would have the same pixel (xi > 1), or the denominator changes sign (xi <= 1).
        edge = -self.xi if self.xi <= 1 else -1 / self.xi
        scale = np.where(z > edge, norm * (z + self.xi), np.nan)
        x, y = (points[:, :2] / scale[:, None]).T
        if any(self.distortion):
            bent_x, bent_y = self._distort(x, y)
            is_unfolded = self._is_unfolded(x, y)
            x, y = np.where(is_unfolded, bent_x, np.nan), np.where(is_unfolded, bent_y, np.nan)
        return np.column_stack([x, y]) * self.focal + self.center

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN outside the sphere's image. Mei and Rives 2007, eq. (5)."""
        x, y = ((np.asarray(pixels, float) - self.center) / self.focal).T
        if any(self.distortion):
            x, y = undistorted(self._distort, self._jacobian, (x, y))
            x = np.where(self._is_unfolded(x, y), x, np.nan)
        r2 = x * x + y * y
        root = 1 + (1 - self.xi**2) * r2
        eta = (self.xi + np.sqrt(np.where(root >= 0, root, np.nan))) / (1 + r2)
        return np.column_stack([eta * x, eta * y, eta - self.xi])

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + k2 * r2)
        return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    def _is_unfolded(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """True (N,) for m up to where the distortion turns back: beyond, it gives the pixels of other rays again."""
        k1, k2, _, _ = self.distortion
        # The slope 1 + 3 k1 r^2 + 5 k2 r^4 of the radius has its first root at the larger 1 / r^2 of two.
        square = 9 * k1 * k1 - 20 * k2
        turning = (np.sqrt(square) - 3 * k1) / 2 if square >= 0 else 0.0
        # p1 and p2 move the turn: the Jacobian is symmetric, and positive definite up to there.
        xx, xy, yy = self._jacobian(x, y)
        return np.asarray(((x * x + y * y) * turning < 1) & (xx > 0) & (xx * yy > xy * xy))

    def _jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return xx, xy, yy, each (N,), of the Jacobian [xx xy; xy yy] of the distortion."""
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (k1 + k2 * r2), 2 * k1 + 4 * k2 * r2
        return (
            radial + slope * x * x + 2 * p1 * y + 6 * p2 * x,
            slope * x * y + 2 * p1 * x + 2 * p2 * y,
            radial + slope * y * y + 6 * p1 * y + 2 * p2 * x,
        )
