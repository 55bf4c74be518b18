"""Models of cameras without a mirror: double sphere, equidistant, and equirectangular images.

A lens sees the world directly, and its image is not flipped. It has no hub in the middle of the image and no
aberrations of a reflected wavefront, as mirrors have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.camera import CONVERGED_PART, NEWTON_STEPS, Array


class _Lens:
    """Common part of all lens models: focal lengths (fu, fv) [px], centre (pu, pv) [px], size."""

    __slots__ = ()
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def _check(self, name: str, *parameters: float, fits: bool = True, expected: str = "") -> None:
        """Raise CalibError for parameters that no such camera has."""
        values = (*parameters, *self.focal, *self.center)
        if not np.isfinite(values).all():
            raise CalibError(f"{name} camera: every parameter must be a finite number, found {values}")
        if min(self.focal) <= 0 or min(self.size) < 1:
            raise CalibError(
                f"{name} camera: expected fu and fv above 0 and a size, found focal {self.focal}, size {self.size}"
            )
        if not fits:
            raise CalibError(f"{name} camera: expected {expected}, found {' and '.join(map(str, parameters))}")

    def _pixels(self, x: Array, y: Array, scale: Array, seen: NDArray[np.bool_]) -> Array:
        """Return the pixels (N, 2) of (x, y) / scale on the plane; NaN for what is not seen."""
        scale = np.where(seen & (scale > 0), scale, np.nan)
        return np.column_stack([x / scale, y / scale]) * self.focal + self.center

    def _plane(self, pixels: Array) -> tuple[Array, Array, Array]:
        """Return mx, my and the square of their radius."""
        mx, my = ((np.asarray(pixels, float) - self.center) / self.focal).T
        return mx, my, mx * mx + my * my


@dataclass(frozen=True, slots=True)
class DoubleSphereCamera(_Lens):
    """Model `ds` of Usenko, Demmel, Cremers 2018, eq. (40) to (51): xi, alpha.

    With z' = xi |p| + z the image is (x, y) / (alpha hypot(x, y, z') + (1 - alpha) z').
    """

    xi: float
    alpha: float
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        fits = -1 < self.xi < 1 and 0 <= self.alpha <= 1
        self._check("ds", self.xi, self.alpha, fits=fits, expected="xi between -1 and 1 and alpha of 0 to 1")

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN where the lens does not see them."""
        x, y, z = np.asarray(points, float).T
        xi, alpha = self.xi, self.alpha
        r2 = x * x + y * y
        d1 = np.sqrt(r2 + z * z)
        shifted = xi * d1 + z
        w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        w2 = (w1 + xi) / np.sqrt(2 * w1 * xi + xi**2 + 1)
        scale = alpha * np.sqrt(r2 + shifted**2) + (1 - alpha) * shifted
        return self._pixels(x, y, scale, seen=(z > -w2 * d1) & (d1 > 0))

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN where there is none."""
        mx, my, r2 = self._plane(pixels)
        xi, alpha = self.xi, self.alpha
        mz = (1 - alpha**2 * r2) / (alpha * _root(1 - (2 * alpha - 1) * r2) + 1 - alpha)
        k = (mz * xi + _root(mz**2 + (1 - xi**2) * r2)) / (mz**2 + r2)
        return np.column_stack([k * mx, k * my, k * mz - xi])


@dataclass(frozen=True, slots=True)
class EquidistantCamera(_Lens):
    """Pinhole with an equidistant lens, `pinhole-equi`, of Kannala and Brandt 2006: k1 to k4.

    The distance from the centre grows with the angle t from the axis: t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).
    """

    coefficients: tuple[float, float, float, float]
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        self._check("equidistant", *self.coefficients)

    @property
    def widest_rad(self) -> float:
        """The angle from the axis up to which the image radius grows."""
        roots = np.roots(self._slope.coef[::-1])
        turns = roots.real[np.isreal(roots) & (roots.real > 0)]
        return float(min([np.pi, *np.sqrt(turns)]))

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN beyond widest_rad. Eq. (6)."""
        x, y, z = np.asarray(points, float).T
        r = np.hypot(x, y)
        angle = np.arctan2(r, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(r > 0, r / self._radius(angle), z)
        return self._pixels(x, y, scale, seen=(angle < self.widest_rad) & np.isfinite(x + y + z))

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2), by Newton's method; NaN where there is none."""
        mx, my, r2 = self._plane(pixels)
        radius, widest, slope = np.sqrt(r2), self.widest_rad, self._slope
        angle = np.minimum(radius, widest)
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                angle = np.clip(angle - (self._radius(angle) - radius) / slope(angle * angle), 0, widest)
            angle = np.where(np.abs(self._radius(angle) - radius) < CONVERGED_PART, angle, np.nan)
            side = np.where(radius > 0, np.sin(angle) / radius, 1.0)
        return np.column_stack([side * mx, side * my, np.cos(angle)])

    def _radius(self, t: Array) -> Array:
        return np.asarray(t * np.polynomial.Polynomial([1.0, *self.coefficients])(t * t))

    @property
    def _slope(self) -> np.polynomial.Polynomial:
        """The derivative of the radius by the angle, as a polynomial of the squared angle."""
        return np.polynomial.Polynomial([(2 * k + 1) * a for k, a in enumerate((1.0, *self.coefficients))])


@dataclass(frozen=True, slots=True)
class EquirectangularCamera(_Lens):
    """Images of 360 degrees as cameras stitch them: columns are azimuths, rows elevations; (fu, fv) of a radian.

    In the camera frame x is to the right, y down, z ahead: u = pu + fu atan2(x, z), v = pv + fv atan2(y, hypot(x, z)).
    A stitched image of a full turn has fu = width / (2 pi); rows may be cut off at its top and its bottom.
    """

    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        self._check("equirectangular")
        if self.size[0] > round(self._period_px):
            raise CalibError(
                f"equirectangular camera: {self.size[0]} columns are more than a full turn of {self._period_px:.1f}"
            )

    @property
    def _period_px(self) -> float:
        return 2 * math.pi * self.focal[0]

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN for the origin and for what is not finite.

        Between the middles of the last and of the first column of a full turn, the nearer one is taken.
        """
        x, y, z = np.asarray(points, float).T
        azimuth, elevation = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        azimuth = np.where(((x == 0) & (y == 0) & (z == 0)) | ~np.isfinite(x + y + z), np.nan, azimuth)
        u, middle = self.center[0] + self.focal[0] * azimuth, (self.size[0] - 1) / 2
        u = middle + (u - middle + self._period_px / 2) % self._period_px - self._period_px / 2
        if round(self._period_px) == self.size[0]:
            u = np.clip(u, 0.0, self.size[0] - 1.0)
        return np.column_stack([u, self.center[1] + self.focal[1] * elevation])

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN above the zenith and below the nadir."""
        azimuth, elevation, _ = self._plane(pixels)
        elevation = np.where(np.abs(elevation) <= math.pi / 2, elevation, np.nan)
        level = np.cos(elevation)
        return np.column_stack([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])


def full_turn(size: tuple[int, int]) -> EquirectangularCamera:
    """Return the camera of whole stitched images: a full turn by half a turn."""
    per_rad = size[0] / (2 * math.pi)
    return EquirectangularCamera((per_rad, per_rad), ((size[0] - 1) / 2, (size[1] - 1) / 2), size)


def _root(values: Array) -> Array:
    """Return square roots; NaN of negative values."""
    return np.asarray(np.sqrt(np.where(values >= 0, values, np.nan)))
