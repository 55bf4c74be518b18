"""A first `ocam` camera and board poses without any guess: Scaramuzza, Martinelli and Siegwart 2006, section IV.

Works in the toolbox's frame: x down the rows, y along the columns, rays (x, y, f(rho)).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.fit.bundle import Observed
from calib.models.camera import Array
from calib.models.ocam import View

# The centre is looked for on a grid this wide, in parts of the image, that shrinks with every round.
SEARCH_PART = 0.16
SEARCH_SIDE = 5
SEARCH_SHRINK = 0.55
SEARCH_END_PX = 0.5
# A corner off by more than this counts no further: one bad image must not steer the centre.
CAP_RAD = 0.05


@dataclass(frozen=True, slots=True)
class LinearCamera:
    """Polynomial in rho / scale_px without its linear term, centre (row, column) and poses; affine is the identity."""

    coefficients: Array  # (D,) of powers 0, 2, 3 ... of rho / scale_px [px]
    scale_px: float
    center: tuple[float, float]
    T_cam_board: Array  # (K, 4, 4)
    errors_rad: Array  # (K,) mean angle between modelled and measured rays


def powers(degree: int) -> Array:
    """Powers of rho that the polynomial has: there is no linear one, a smooth mirror is level on its axis."""
    return np.array([0, *range(2, degree + 1)])


def solve_linear(observed: Observed, size: tuple[int, int], degree: int, view: View) -> LinearCamera:
    """The camera and poses of least ray error, the centre found by search; size (width, height) [px]."""
    width, height = size
    problem = _Problem(observed, degree, min(size) / 2)
    center, reach = np.array([(height - 1) / 2, (width - 1) / 2]), SEARCH_PART * max(size)
    while reach > SEARCH_END_PX:
        steps = np.linspace(-reach, reach, SEARCH_SIDE)
        trials = [center + np.array([row, column]) for row in steps for column in steps]
        center = min(trials, key=lambda trial: float(np.nanmean(problem.solve(trial).errors_rad)))
        reach *= SEARCH_SHRINK
    return _seen(problem.solve(center), view)


def _seen(solution: LinearCamera, view: View) -> LinearCamera:
    """The solution with proper poses in the camera's frame: in a mirror z is turned round."""
    T = solution.T_cam_board.copy()
    if view == "mirror":
        T[:, 2, [0, 1, 3]] *= -1
    left, _, right = np.linalg.svd(T[:, :3, :2], full_matrices=False)
    first = left @ right
    R = np.concatenate([first, np.cross(first[..., 0], first[..., 1])[..., None]], axis=-1)
    return LinearCamera(solution.coefficients, solution.scale_px, solution.center,
                        se3.transform(R, T[:, :3, 3]), solution.errors_rad)


@dataclass(frozen=True, slots=True)
class _Problem:
    observed: Observed
    degree: int
    scale_px: float

    def solve(self, center: Array) -> LinearCamera:
        """Poses and polynomial for a centre (row, column)."""
        xy = self.observed.pixels[..., ::-1] - center
        T = _partial_poses(xy, self.observed.points)
        across = np.linalg.norm(se3.apply(T, self.observed.points)[..., :2], axis=2)
        rho = np.linalg.norm(xy, axis=2)
        height = self.observed.points[:, :2] @ T[:, 2, :2].swapaxes(0, 1)
        T[:, 2, :2] *= _signs(rho, across, height.T, self.scale_px)[:, None]
        height = (self.observed.points[:, :2] @ T[:, 2, :2].swapaxes(0, 1)).T
        coefficients, T[:, 2, 3] = _polynomial(rho, across, height, self.basis(rho))
        f = self.basis(rho) @ coefficients
        errors = np.minimum(_angles(np.dstack([xy, f]), se3.apply(T, self.observed.points)), CAP_RAD)
        return LinearCamera(coefficients, self.scale_px, (float(center[0]), float(center[1])), T,
                            np.nanmean(errors, axis=1))

    def basis(self, rho: Array) -> Array:
        """Powers (..., D) of the scaled radius."""
        return np.asarray((rho[..., None] / self.scale_px) ** powers(self.degree))


def _partial_poses(xy: Array, points: Array) -> Array:
    """Poses (K, 4, 4) up to t3 and the sign of (r31, r32), from (x, y) || (P1, P2): eq. (11) to (14)."""
    X, Y = points[:, 0], points[:, 1]
    known = np.isfinite(xy[..., :1])
    x, y = np.nan_to_num(xy[..., 0]), np.nan_to_num(xy[..., 1])
    rows = np.stack([-y * X, -y * Y, -y, x * X, x * Y, x], axis=-1) * known
    scale = np.linalg.norm(rows, axis=1, keepdims=True)
    h = np.linalg.svd(rows / scale, full_matrices=True)[2][:, -1] / scale[:, 0]
    T = np.tile(np.eye(4), (len(h), 1, 1))
    T[:, :2, [0, 1, 3]] = h.reshape(-1, 2, 3)
    across = se3.apply(T, points)[..., :2]
    T[:, :2, [0, 1, 3]] *= np.sign(np.nansum(across * xy, axis=(1, 2)))[:, None, None]
    T[:, 2, :2] = _third_row(T[:, :2, :2])
    T[:, :3, [0, 1, 3]] /= np.linalg.norm(T[:, :3, :1], axis=1, keepdims=True)
    return T


def _third_row(R: Array) -> Array:
    """(r31, r32) (K, 2) that make the two columns of R (K, 2, 2) equally long and orthogonal."""
    product = -(R[:, :, 0] * R[:, :, 1]).sum(axis=1)
    gap = (R[:, :, 1] ** 2).sum(axis=1) - (R[:, :, 0] ** 2).sum(axis=1)
    root = np.hypot(gap, 2 * product)
    first = np.sqrt(np.maximum(0, (root + gap) / 2))
    second = np.sqrt(np.maximum(0, (root - gap) / 2)) * np.where(product < 0, -1, 1)
    return np.column_stack([first, second])


def _signs(rho: Array, across: Array, height: Array, scale_px: float) -> Array:
    """Which sign (K,) of (r31, r32) gives each image a parabola f with a0 < 0: negating all of f fits as well."""
    A, b, _ = _without_shifts(rho, across, height, (rho[..., None] / scale_px) ** powers(2))
    parabolas = np.linalg.pinv(A) @ b[..., None]
    return np.where(parabolas[:, 0, 0] > 0, -1.0, 1.0)


def _polynomial(rho: Array, across: Array, height: Array, basis: Array) -> tuple[Array, Array]:
    """Coefficients (D,) and t3 (K,) of f(rho) * across = rho * (height + t3), least squares: eq. (15) to (18)."""
    A, b, shifts = _without_shifts(rho, across, height, basis)
    flat = A.reshape(-1, A.shape[-1])
    size = np.linalg.norm(flat, axis=0)
    coefficients = np.linalg.lstsq(flat / size, b.ravel(), rcond=None)[0] / size
    return coefficients, shifts(coefficients)


def _without_shifts(rho: Array, across: Array, height: Array, basis: Array
                    ) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Equations (K, N, D) and right sides (K, N) for the coefficients alone, and the t3 (K,) that go with these.

    Every t3 stands in its own image's equations only: these are projected to where it does not count.
    """
    known, weight = np.isfinite(rho), 1 / np.maximum(across, 1e-9)
    A = np.where(known[..., None], basis * (across * weight)[..., None], 0.0)
    b, shift = (np.where(known, side * rho * weight, 0.0) for side in (height, -1.0))
    squared = np.maximum((shift**2).sum(axis=1), 1e-300)
    along_A, along_b = ((shift[:, None] @ side)[:, 0] / squared[:, None] for side in (A, b[..., None]))

    def shifts(coefficients: Array) -> Array:
        return np.asarray(along_b[:, 0] - along_A @ coefficients)

    return A - shift[..., None] * along_A[:, None], b - shift * along_b, shifts


def _angles(rays: Array, points: Array) -> Array:
    """Angles (K, N) [rad] between rays and points (K, N, 3)."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(rays, points), axis=2), (rays * points).sum(axis=2)))
