"""Models of fisheye lenses that Kalibr calibrates: double sphere, extended unified, and pinhole with equidistant lens.

A lens sees the world directly, and nothing is flipped. What belongs to mirrors does not apply to it: a hub in the
middle of the image, and aberrations of a reflected wavefront.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.models.camera import CONVERGED_PART, NEWTON_STEPS, Array


@dataclass(frozen=True, slots=True)
class DoubleSphereCamera:
    """Model `ds` of Usenko, Demmel, Cremers 2018: xi, alpha, focal lengths (fu, fv) [px], centre (pu, pv) [px]."""

    xi: float
    alpha: float
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        check_plane("ds", (self.xi, self.alpha), self.focal, self.center, self.size)
        if not (-1 < self.xi < 1 and 0 <= self.alpha <= 1):
            raise CalibError(
                f"ds camera: expected xi between -1 and 1 and alpha of 0 to 1, found {self.xi} and {self.alpha}"
            )

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN where the lens does not see them. Eq. (40) to (45)."""
        x, y, z = np.asarray(points, float).T
        d1 = np.sqrt(x * x + y * y + z * z)
        shifted = self.xi * d1 + z
        w1 = _edge(self.alpha)
        w2 = (w1 + self.xi) / np.sqrt(2 * w1 * self.xi + self.xi**2 + 1)
        scale = self.alpha * np.sqrt(x * x + y * y + shifted**2) + (1 - self.alpha) * shifted
        return _pixels(self, x, y, scale, seen=(z > -w2 * d1) & (d1 > 0))

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN where there is none. Eq. (46) to (51)."""
        mx, my, r2 = _plane(self, pixels)
        mz = _height(self.alpha, r2)
        k = (mz * self.xi + _root(mz**2 + (1 - self.xi**2) * r2)) / (mz**2 + r2)
        return np.column_stack([k * mx, k * my, k * mz - self.xi])


@dataclass(frozen=True, slots=True)
class ExtendedUnifiedCamera:
    """Model `eucm` of Khomutenko, Garcia, Martinet 2016: alpha, beta, focal lengths (fu, fv), centre (pu, pv) [px]."""

    alpha: float
    beta: float
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        check_plane("eucm", (self.alpha, self.beta), self.focal, self.center, self.size)
        if not (0 <= self.alpha <= 1 and self.beta > 0):
            raise CalibError(f"eucm camera: expected alpha of 0 to 1 and beta above 0, found {self.alpha}, {self.beta}")

    def project(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3); NaN where the lens does not see them. Eq. (3) to (5)."""
        x, y, z = np.asarray(points, float).T
        d = np.sqrt(self.beta * (x * x + y * y) + z * z)
        scale = self.alpha * d + (1 - self.alpha) * z
        return _pixels(self, x, y, scale, seen=(z > -_edge(self.alpha) * d) & (d > 0))

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2); NaN where there is none. Eq. (12)."""
        mx, my, r2 = _plane(self, pixels)
        mz = _height(self.alpha, self.beta * r2)
        return np.asarray(np.column_stack([mx, my, mz]) / np.sqrt(r2 + mz**2)[:, None])


@dataclass(frozen=True, slots=True)
class EquidistantCamera:
    """Pinhole with an equidistant lens, `pinhole-equi`, of Kannala and Brandt 2006: k1 to k4, (fu, fv), (pu, pv) [px].

    The distance from the centre grows with the angle t from the axis: t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).
    """

    coefficients: tuple[float, float, float, float]
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        check_plane("equidistant", self.coefficients, self.focal, self.center, self.size)

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
        return _pixels(self, x, y, scale, seen=(angle < self.widest_rad) & np.isfinite(x + y + z))

    def lift(self, pixels: Array) -> Array:
        """Return unit rays (N, 3) of pixels (N, 2), by Newton's method; NaN where there is none."""
        mx, my, r2 = _plane(self, pixels)
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


LensCamera = DoubleSphereCamera | ExtendedUnifiedCamera | EquidistantCamera


def check_plane(
    name: str,
    parameters: tuple[float, ...],
    focal: tuple[float, float],
    center: tuple[float, float],
    size: tuple[int, int],
) -> None:
    """Raise CalibError for parameters that no camera without a flip has."""
    values = (*parameters, *focal, *center)
    if not np.isfinite(values).all():
        raise CalibError(f"{name} camera: every parameter must be a finite number, found {values}")
    if min(focal) <= 0 or min(size) < 1:
        raise CalibError(f"{name} camera: expected fu and fv above 0 and a size, found focal {focal}, size {size}")


def _edge(alpha: float) -> float:
    """Return the bound of z / distance of visible points, its sign changed."""
    return alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha


def _height(alpha: float, r2: Array) -> Array:
    """Return the third component of the ray of a point of the plane at a squared radius; NaN where there is none."""
    return np.asarray((1 - alpha**2 * r2) / (alpha * _root(1 - (2 * alpha - 1) * r2) + 1 - alpha))


def _root(values: Array) -> Array:
    """Return square roots; NaN of negative values."""
    return np.asarray(np.sqrt(np.where(values >= 0, values, np.nan)))


def _pixels(camera: LensCamera, x: Array, y: Array, scale: Array, seen: NDArray[np.bool_]) -> Array:
    """Return the pixels (N, 2) of (x, y) / scale on the plane; NaN for what is not seen."""
    scale = np.where(seen & (scale > 0), scale, np.nan)
    return np.column_stack([x / scale, y / scale]) * camera.focal + camera.center


def _plane(camera: LensCamera, pixels: Array) -> tuple[Array, Array, Array]:
    """Return mx, my and the square of their radius."""
    mx, my = ((np.asarray(pixels, float) - camera.center) / camera.focal).T
    return mx, my, mx * mx + my * my
