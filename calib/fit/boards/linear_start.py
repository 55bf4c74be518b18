"""Linear initialisation of an `ocam` camera and board poses: Scaramuzza, Martinelli and Siegwart 2006, section IV.

Frame of the toolbox: x down the rows, y along the columns, rays (x, y, f(rho)).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array
from calib.models.ocam import OcamCamera, View

# The polynomial of a surface without a tip has even powers of rho.
POWERS = np.array([0, 2, 4])

# Grid search for the centre: start half width in parts of the image.
SEARCH_PART = 0.16
# Points per axis of the first round and of the others. Each goes from the best point of the last one half-way to its
# neighbours, and a tenth farther.
FIRST_SIDE, SEARCH_SIDE = 5, 3
SEARCH_PART_OF_STEP = 0.55
# Width at which the search ends, because the fit that follows refines the centre.
SEARCH_END_PX = 0.5
# Guards against division by zero.
TINY = np.finfo(float).tiny


@dataclass(frozen=True, slots=True)
class LinearCamera:
    """A camera with identity affine, and the poses of the board in K views."""

    coefficients: Array  # (D,) of POWERS of rho / scale_px [px]
    scale_px: float
    center: tuple[float, float]  # (row, column) [px]
    T_cam_board: Array  # (K, 4, 4)
    errors_rad: Array  # (K,) mean angle between modelled and measured rays

    def camera(self, size: tuple[int, int], view: View) -> OcamCamera:
        """Return the camera; CalibError where the rays point away from what it sees."""
        if self.coefficients[0] >= 0:
            raise CalibError(
                "calibrate: no mirror or lens shows boards as in these views; leave out those whose corners "
                "are wrong, and check --corners"
            )
        polynomial = np.zeros(POWERS[-1] + 1)
        polynomial[POWERS] = self.coefficients / self.scale_px ** POWERS.astype(float)
        return OcamCamera(tuple(polynomial.tolist()), self.center, (1.0, 0.0, 0.0), size, view)


def solve_linear(pixels: Array, points: Array, size: tuple[int, int], view: View) -> LinearCamera:
    """Find the camera and poses of least ray error, with a search over the centre.

    pixels (K, N, 2): corners of board points (N, 3). size (width, height) [px].
    """
    width, height = size
    problem = _LinearProblem(pixels, points, min(size) / 2)
    center, reach = np.array([(height - 1) / 2, (width - 1) / 2]), SEARCH_PART * max(size)
    side = FIRST_SIDE
    while reach > SEARCH_END_PX:
        steps = np.linspace(-reach, reach, side)
        trials = [center + np.array([row, column]) for row in steps for column in steps]
        # By the median view: one bad image does not determine the centre.
        center = min(trials, key=lambda trial: float(np.nanmedian(problem.solve(trial).errors_rad)))
        reach, side = SEARCH_PART_OF_STEP * (steps[1] - steps[0]), SEARCH_SIDE
    return _with_proper_poses(problem.solve(center), view)


def _with_proper_poses(solution: LinearCamera, view: View) -> LinearCamera:
    """Return the solution with rigid poses in the camera's frame; for a mirror z is negated."""
    T = solution.T_cam_board.copy()
    if view == "mirror":
        T[:, 2, [0, 1, 3]] *= -1
    left, _, right = np.linalg.svd(T[:, :3, :2], full_matrices=False)
    first = left @ right
    R = np.concatenate([first, np.cross(first[..., 0], first[..., 1])[..., None]], axis=-1)
    return LinearCamera(
        solution.coefficients, solution.scale_px, solution.center, se3.transform(R, se3.t_of(T)), solution.errors_rad
    )


@dataclass(frozen=True, slots=True)
class _LinearProblem:
    pixels: Array  # (K, N, 2)
    points: Array  # (N, 3)
    scale_px: float

    def solve(self, center: Array) -> LinearCamera:
        """Solve for poses and polynomial at a given centre (row, column)."""
        xy = self.pixels[..., ::-1] - center
        T = _partial_poses(xy, self.points)
        across = np.linalg.norm(se3.apply(T, self.points)[..., :2], axis=2)
        rho = np.linalg.norm(xy, axis=2)
        height = self.points[:, :2] @ T[:, 2, :2].swapaxes(0, 1)
        basis = (rho[..., None] / self.scale_px) ** POWERS
        # The sign of (r31, r32) for which each image's parabola f has a0 < 0; -f fits equally well.
        A, b, _ = _eliminate_depths(rho, across, height.T, basis[..., :2])
        T[:, 2, :2] *= np.where((np.linalg.pinv(A) @ b[..., None])[:, 0] > 0, -1.0, 1.0)
        # f(rho) * across = rho * (height + t3) for the coefficients and t3, eq. (15) to (18).
        height = (self.points[:, :2] @ T[:, 2, :2].swapaxes(0, 1)).T
        A, b, shifts = _eliminate_depths(rho, across, height, basis)
        size = np.linalg.norm(A, axis=(0, 1))
        coefficients = np.linalg.lstsq(A.reshape(-1, len(size)) / size, b.ravel(), rcond=None)[0] / size
        T[:, 2, 3] = shifts(coefficients)
        errors = _angles(np.dstack([xy, basis @ coefficients]), se3.apply(T, self.points))
        return LinearCamera(
            coefficients, self.scale_px, (float(center[0]), float(center[1])), T, np.nanmean(errors, axis=1)
        )


def _partial_poses(xy: Array, points: Array) -> Array:
    """Return poses (K, 4, 4) up to t3 and the sign of (r31, r32), from (x, y) || (P1, P2): eq. (11) to (14)."""
    X, Y = points[:, 0], points[:, 1]
    known = np.isfinite(xy[..., :1])
    x, y = np.nan_to_num(xy[..., 0]), np.nan_to_num(xy[..., 1])
    rows = np.stack([-y * X, -y * Y, -y, x * X, x * Y, x], axis=-1) * known
    scale = np.linalg.norm(rows, axis=1, keepdims=True)
    h = np.linalg.svd(rows / scale, full_matrices=False)[2][:, -1] / scale[:, 0]
    T = np.tile(np.eye(4), (len(h), 1, 1))
    T[:, :2, [0, 1, 3]] = h.reshape(-1, 2, 3)
    across = se3.apply(T, points)[..., :2]
    T[:, :2, [0, 1, 3]] *= np.sign(np.nansum(across * xy, axis=(1, 2)))[:, None, None]
    # r31 and r32 make the two columns of the rotation equally long and orthogonal.
    first, second = T[:, :2, 0], T[:, :2, 1]
    product = -(first * second).sum(axis=1)
    gap = (second**2 - first**2).sum(axis=1)
    root = np.hypot(gap, 2 * product)
    T[:, 2, 0] = np.sqrt(np.maximum(0, (root + gap) / 2))
    T[:, 2, 1] = np.sqrt(np.maximum(0, (root - gap) / 2)) * np.where(product < 0, -1, 1)
    T[:, :3, [0, 1, 3]] /= np.linalg.norm(T[:, :3, :1], axis=1, keepdims=True)
    return T


def _eliminate_depths(
    rho: Array, across: Array, height: Array, basis: Array
) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Eliminate t3: return equations (K, N, D), right sides (K, N), and a function from coefficients to t3 (K,).

    Every t3 occurs in its own image's equations only: these are projected onto the complement of its column.
    """
    known, weight = np.isfinite(rho), 1 / np.maximum(across, TINY)
    A = np.where(known[..., None], basis * (across * weight)[..., None], 0.0)
    b, shift = (np.where(known, side * rho * weight, 0.0) for side in (height, -1.0))
    squared = np.maximum((shift**2).sum(axis=1), TINY)
    along_A, along_b = ((shift[:, None] @ side)[:, 0] / squared[:, None] for side in (A, b[..., None]))

    def shifts(coefficients: Array) -> Array:
        return np.asarray(along_b[:, 0] - along_A @ coefficients)

    return A - shift[..., None] * along_A[:, None], b - shift * along_b, shifts


def _angles(rays: Array, points: Array) -> Array:
    """Return angles (K, N) [rad] between rays and points (K, N, 3)."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(rays, points), axis=2), (rays * points).sum(axis=2)))
