"""The polynomial model of OCamCalib (Scaramuzza et al. 2006) for central mirrors and fisheye lenses.

x = row - row centre and y = column - column centre, after the inverse of the affine [c d; e 1]; rho = |(x, y)|.
Seen directly the ray is (x, y, f(rho)) with x down, y right, z towards the viewer. Seen in a mirror the image is
reflected and the right-handed ray is (x, y, -f(rho)). A flat board cannot distinguish the two, so `view` selects one.

Two optional tangential (decentring) terms p1, p2 [1/px] describe a camera off the axis of the mirror (Brown 1966).
They act between the ideal point (x, y) and the affine:

    x' = x + 2 p1 x y + p2 (rho^2 + 2 x^2),    y' = y + p1 (rho^2 + 2 y^2) + 2 p2 x y

Optional terms of real mirrors: secondary astigmatism s1, s2 [1/px^2] adds the gradient of rho^2 (s1 (x^2 - y^2) + 2 s2
x y) to x', y'; wavefront (models/wavefront.py) describes rays that do not meet in one point. project() and lift() are
central all the same: exact for points at distance_m. project_near() uses the points' own distances.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models import wavefront as wavefronts
from calib.models.camera import CONVERGED_PART, NEWTON_STEPS, Array, OmniCamera, undistorted

View = Literal["mirror", "direct"]
# The tangential and the astigmatic terms, as files and results name them.
TANGENTIAL_NAMES, ASTIGMATISM_NAMES = ("p1", "p2"), ("s1", "s2")

# Size of the table of radii in which the inversion starts, so that each solution stays within one interval.
TABLE_SIZE = 1025
# A camera with a wavefront is exact for points at this distance; half of it and twice as far have the same error.
DISTANCE_M = 1.5
NO_WAVEFRONT = (0.0,) * len(wavefronts.WAVEFRONT_NAMES)


@dataclass(frozen=True, slots=True)
class OcamCamera:
    """Model `ocam`: polynomial (a0, a1, ...) with a0 < 0 [px], centre (row, column), affine (c, d, e), size (w, h)."""

    polynomial: tuple[float, ...]
    center_row_column: tuple[float, float]
    affine: tuple[float, float, float]
    size: tuple[int, int]
    view: View = "mirror"
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2 [1/px]
    astigmatism: tuple[float, float] = (0.0, 0.0)  # s1, s2 [1/px^2]
    wavefront: tuple[float, ...] = NO_WAVEFRONT  # [m]
    distance_m: float = DISTANCE_M
    _radii: Array = field(init=False, repr=False, compare=False)
    _angles: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 1 <= len(self.polynomial) <= 32:  # their roots are those of a square matrix
            raise CalibError(f"ocam camera: expected 1 to 32 coefficients, found {len(self.polynomial)}")
        parts = (self.polynomial, self.center_row_column, self.affine, self.tangential, self.astigmatism)
        values = [value for part in (*parts, self.wavefront) for value in part]
        c, d, e = self.affine
        with np.errstate(all="ignore"):
            values.append(float(self.height_and_slope(np.hypot(*self.size))[0]))
        if not (
            np.isfinite(values).all()
            and self.polynomial[0] < 0
            and c != d * e
            and min(self.size) > 0
            and self.distance_m > 0
        ):
            raise CalibError(
                "ocam camera: expected finite coefficients with a0 < 0, an invertible affine, a size, distance_m above "
                f"0, found a0 {self.polynomial[:1]}, affine {self.affine}, size {self.size}, {self.distance_m} m"
            )
        radii = np.linspace(0, self.radius_limit_px, TABLE_SIZE)
        object.__setattr__(self, "_radii", radii)
        object.__setattr__(self, "_angles", np.maximum.accumulate(np.arctan2(self.height_and_slope(radii)[0], radii)))

    @property
    def center(self) -> tuple[float, float]:
        """Return the pixel (u, v) = (column, row) of the axis."""
        row, column = self.center_row_column
        return column, row

    @property
    def radius_limit_px(self) -> float:
        """Return the model's largest radius: the image diagonal, or the radius at which f(rho)/rho stops rising.

        Beyond that radius two pixels would have the same ray.
        """
        diagonal = float(np.hypot(*self.size))
        # rho f'(rho) - f(rho) is rho^2 times the slope of f(rho) / rho.
        turning = np.roots([(power - 1) * a for power, a in enumerate(self.polynomial)][::-1])
        real = turning.real[np.isreal(turning) & (turning.real > 0)]
        return min(diagonal, float(real.min())) if real.size else diagonal

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN beyond the model's radius. Scaramuzza et al. 2006, eq. (6)."""
        pixels = np.asarray(pixels, float)
        c, d, e = self.affine
        row, column = pixels[:, 1] - self.center_row_column[0], pixels[:, 0] - self.center_row_column[1]
        x, y = (row - d * column) / (c - d * e), (c * column - e * row) / (c - d * e)
        if self._is_distorted:
            x, y = undistorted(self.distort, self.distortion_jacobian, (x, y))
            x = np.where(self._is_unfolded(x, y), x, np.nan)
        rho = np.hypot(x, y)
        z, _ = self.height_and_slope(np.where(rho <= self._radii[-1], rho, np.nan))
        rays = np.column_stack([x, y, self.sign * z])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        if any(self.wavefront):
            return wavefronts.points_at(self.distance_m, rays, self.wavefront, -self.sign)
        return np.asarray(rays)

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN if no radius of the model has their ray.

        Solves f(rho) exactly, instead of the inverse polynomial of OCamCalib's file.
        """
        points = np.asarray(points, float)
        if any(self.wavefront):
            norm = np.linalg.norm(points, axis=1, keepdims=True)
            points = self.distance_m * points / np.where(norm > 0, norm, np.nan)
        return self.project_near(points)

    def project_near(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) [m] at their own distances; like project() without a wavefront."""
        points = np.asarray(points, float)
        if any(self.wavefront):
            points = wavefronts.directions_to(points, self.wavefront, -self.sign)
        r = np.hypot(points[:, 0], points[:, 1])
        rho = self.radius(r, self.sign * points[:, 2])
        scale = rho / np.where(r > 0, r, 1.0)
        x, y = points[:, 0] * scale, points[:, 1] * scale
        if self._is_distorted:
            bent_x, bent_y = self.distort(x, y)
            is_unfolded = self._is_unfolded(x, y)
            x, y = np.where(is_unfolded, bent_x, np.nan), np.where(is_unfolded, bent_y, np.nan)
        c, d, e = self.affine
        row, column = self.center_row_column
        return np.column_stack([e * x + y + column, c * x + d * y + row])

    @property
    def _is_distorted(self) -> bool:
        return any(self.tangential) or any(self.astigmatism)

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Apply the tangential and astigmatic terms to ideal points x, y (N,) [px]."""
        (p1, p2), (s1, s2) = self.tangential, self.astigmatism
        x2, xy, y2 = x * x, x * y, y * y
        x3, y3, rho2 = x2 * x, y2 * y, x2 + y2  # numpy's x**3 takes ten times as long
        return (
            x + 2 * p1 * xy + p2 * (rho2 + 2 * x2) + 4 * s1 * x3 + s2 * (6 * x2 * y + 2 * y3),
            y + p1 * (rho2 + 2 * y2) + 2 * p2 * xy - 4 * s1 * y3 + s2 * (2 * x3 + 6 * x * y2),
        )

    def _is_unfolded(self, x: Array, y: Array) -> NDArray[np.bool_]:
        """True (N,) up to where the terms turn back, to pixels of other rays: their symmetric Jacobian is positive."""
        xx, xy, yy = self.distortion_jacobian(x, y)
        return np.asarray((xx > 0) & (xx * yy > xy * xy))

    def distortion_jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return xx, xy, yy, each (N,), of the Jacobian [xx xy; xy yy] of the tangential and astigmatic terms."""
        (p1, p2), (s1, s2) = self.tangential, self.astigmatism
        xx2, xy2, yy2 = x * x, x * y, y * y
        return (
            1 + 2 * p1 * y + 6 * p2 * x + 12 * (s1 * xx2 + s2 * xy2),
            2 * p1 * x + 2 * p2 * y + 6 * s2 * (xx2 + yy2),
            1 + 6 * p1 * y + 2 * p2 * x + 12 * (s2 * xy2 - s1 * yy2),
        )

    @property
    def sign(self) -> float:
        """The sign of z of rays that are seen in a mirror, -1, or directly, 1."""
        return -1.0 if self.view == "mirror" else 1.0

    def radius(self, r: Array, z: Array) -> Array:
        """Solve f(rho) * r = z * rho for rho (N,) by Newton steps within one interval of the table."""
        norm = np.hypot(r, z)
        unit = np.where((norm > 0) & np.isfinite(norm), norm, np.nan)
        r, z, angle = r / unit, z / unit, np.arctan2(z, r)
        above = np.clip(np.searchsorted(self._angles, angle), 1, TABLE_SIZE - 1)
        low, high = self._radii[above - 1], self._radii[above]
        rho = (low + high) / 2
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                height, slope = self.height_and_slope(rho)
                value = height * r - z * rho
                is_below = value < 0
                low, high = np.where(is_below, rho, low), np.where(is_below, high, rho)
                step = np.minimum(np.maximum(rho - value / (slope * r - z), low), high)
                before, rho = rho, np.where(np.isnan(step), (low + high) / 2, step)
                # The error left is of the order of the square of the step, below the last bit.
                if not (np.abs(rho - before) > CONVERGED_PART).any():
                    break
        return np.where(np.isfinite(unit) & (angle <= self._angles[-1]), rho, np.nan)

    def height_and_slope(self, radius_px: Array) -> tuple[Array, Array]:
        """Return f(rho) (N,) [px], the ray's third component before the mirror's sign, and f'(rho) (N,).

        By one Horner scheme: numpy's two take most of a calibration's time.
        """
        height, slope = np.full_like(radius_px, self.polynomial[-1]), np.zeros_like(radius_px)
        for coefficient in self.polynomial[-2::-1]:
            slope *= radius_px
            slope += height
            height *= radius_px
            height += coefficient
        return height, slope


def project_near(camera: OmniCamera, points: Array) -> Array:
    """Return pixels (N, 2) of points (N, 3) [m] at their own distances, by a camera of any model."""
    return camera.project_near(points) if isinstance(camera, OcamCamera) else camera.project(points)
