"""Start values of a calibration by boards: a camera and poses by a linear solution, then the transform of two cameras.

The linear solution is that of Scaramuzza, Martinelli and Siegwart 2006, section IV. Its frame is the toolbox's: x down
the rows, y along the columns, rays (x, y, f(rho)). The transform is that of the most pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array
from calib.models.ocam import OcamCamera, View

# The polynomial of a surface without a tip has even powers of rho.
POWERS = np.array([0, 2, 4])

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
    xy1, scale_px = np.column_stack([points[:, :2], np.ones(len(points))]), min(size) / 2
    # 1. The centre, by the median view: one bad image does not determine it. The fit that follows refines it.
    found = scipy.optimize.minimize(
        lambda center: float(np.nanmedian(_solve(pixels, xy1, scale_px, center)[2])),
        np.array([(height - 1) / 2, (width - 1) / 2]),
        method="Nelder-Mead",
        options={"xatol": 0.5, "fatol": np.inf},
    )
    center = np.asarray(found.x)
    # 2. Rigid poses in the camera's frame; for a mirror z is negated.
    coefficients, columns, errors_rad = _solve(pixels, xy1, scale_px, center)
    if view == "mirror":
        columns[:, -1] *= -1
    return LinearCamera(coefficients, scale_px, tuple(center.tolist()), pose_of_columns(columns), errors_rad)


def _solve(pixels: Array, xy1: Array, scale_px: float, center: Array) -> tuple[Array, Array, Array]:
    """Solve for a camera and poses at a given centre (row, column).

    Returns the coefficients (D,), the columns r1, r2, t of the poses (K, 3, 3), and the mean angles (K,) [rad] between
    modelled and measured rays. xy1 (N, 3): x, y, 1 of the board's points.
    """
    xy = pixels[..., ::-1] - center
    # 1. The columns up to t3 and the sign of (r31, r32), from (x, y) || (P1, P2): eq. (11) to (14).
    x, y = np.moveaxis(np.nan_to_num(xy)[..., None], 2, 0)
    rows = np.concatenate([-y * xy1, x * xy1], axis=-1)
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    h = np.linalg.svd(rows / size, full_matrices=False)[2][:, -1] / size[:, 0]
    columns = np.zeros((len(h), *2 * xy1.shape[1:]))
    columns[:, :2] = h.reshape(len(h), 2, -1)
    ahead = xy1 @ columns[:, :2].swapaxes(1, 2)
    columns *= np.sign(np.nansum(ahead * xy, axis=(1, 2)))[:, None, None]
    # 2. r31 and r32 make the two columns of the rotation equally long and orthogonal.
    first, second = columns[:, :2, 0], columns[:, :2, 1]
    product, gap = -(first * second).sum(axis=1), (second**2 - first**2).sum(axis=1)
    root = np.hypot(gap, 2 * product)
    columns[:, 2, 0] = np.sqrt(np.maximum(0, (root + gap) / 2))
    columns[:, 2, 1] = np.sqrt(np.maximum(0, (root - gap) / 2)) * np.where(product < 0, -1, 1)
    columns /= np.linalg.norm(columns[..., :1], axis=1, keepdims=True)
    # 3. Their sign, for which each image's parabola f has a0 < 0; -f fits equally well.
    rho, across = np.linalg.norm(xy, axis=2), np.linalg.norm(xy1 @ columns[:, :2].swapaxes(1, 2), axis=2)
    basis = (rho[..., None] / scale_px) ** POWERS
    A, b, _ = _eliminate_depths(rho, across, columns[:, 2] @ xy1.T, basis[..., :2])
    columns[:, 2] *= np.where((np.linalg.pinv(A) @ b[..., None])[:, 0] > 0, -1.0, 1.0)
    # 4. f(rho) * across = rho * (height + t3) for the coefficients and t3, eq. (15) to (18).
    A, b, shifts = _eliminate_depths(rho, across, columns[:, 2] @ xy1.T, basis)
    size = np.linalg.norm(A, axis=(0, 1))
    coefficients = np.linalg.lstsq(A.reshape(-1, len(size)) / size, b.ravel(), rcond=None)[0] / size
    columns[:, 2, 2] = shifts(coefficients)
    # 5. The angles between rays and points.
    rays, seen = np.dstack([xy, basis @ coefficients]), xy1 @ columns.swapaxes(1, 2)
    angles = np.arctan2(np.linalg.norm(np.cross(rays, seen), axis=2), (rays * seen).sum(axis=2))
    return coefficients, columns, np.nanmean(angles, axis=1)


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


# Distance of two transforms: angle [rad] plus shift relative to the baseline. A pair is an inlier below INLIER_RATIO
# times the median distance, within these limits.
MIN_INLIER_DISTANCE, MAX_INLIER_DISTANCE, INLIER_RATIO = 0.06, 0.3, 5.0


@dataclass(frozen=True, slots=True)
class RelativePoseInitialisation:
    """The relative pose of two cameras, and the views consistent with it."""

    T_upper_lower: Array  # (4, 4)
    T_lower_board: dict[int, Array]  # (4, 4) by view
    rejected: tuple[tuple[int, str], ...]  # view and reason


def initialise_relative_pose(lower: Mapping[int, Array], upper: Mapping[int, Array]) -> RelativePoseInitialisation:
    """Find the transform with the most consistent pairs, by poses (4, 4) of the board in front of each camera."""
    # 1. The transform by each pair of views.
    both = sorted(lower.keys() & upper.keys())
    # 2. Consensus of the transforms of all pairs.
    best, gap = _consensus(np.array([upper[k] @ se3.inverse(lower[k]) for k in both]))
    limit = float(np.clip(INLIER_RATIO * np.median(gap), MIN_INLIER_DISTANCE, MAX_INLIER_DISTANCE))
    outliers = {k: float(gap[i]) for i, k in enumerate(both) if gap[i] > limit}
    # 3. The pose of the board in the lower camera's frame, for each view that is left. Outlier pairs are rejected.
    placed = {k: se3.inverse(best) @ T for k, T in upper.items() if k not in lower}
    placed |= {k: T for k, T in lower.items() if k not in outliers}
    rejected = tuple(
        (
            k,
            f"its relative pose of the cameras is {np.rad2deg(distance):.1f} deg or more off that of the "
            "others: was the board moving?",
        )
        for k, distance in outliers.items()
    )
    return RelativePoseInitialisation(best, dict(sorted(placed.items())), rejected)


def pose_of_columns(columns: Array) -> Array:
    """Return the rigid transform (..., 4, 4) of columns r1, r2, t (..., 3, 3), of which r1 and r2 are nearly unit."""
    left, _, right = np.linalg.svd(columns[..., :2], full_matrices=False)
    first, second = np.moveaxis(left @ right, -1, 0)
    return se3.transform(np.stack([first, second, np.cross(first, second)], axis=-1), columns[..., 2])


def _consensus(candidates: Array) -> tuple[Array, Array]:
    """Return the candidate (4, 4) of (K, 4, 4) with the most support, and the distances (K,) of all from it."""
    # The distances (K, K) of all from each: angle [rad] plus shift as a fraction of the length of the translation.
    R, t = se3.R_of(candidates), se3.t_of(candidates)
    gaps = se3.rotation_log(np.swapaxes(R, -1, -2) @ R[:, None])
    length = np.maximum(np.linalg.norm(t, axis=-1), np.finfo(float).tiny)[:, None]
    apart = np.linalg.norm(gaps, axis=-1) + np.linalg.norm(t - t[:, None], axis=-1) / length
    # All outliers have the same cost: MSAC (Torr and Zisserman 2000).
    best = int(np.minimum(apart, MAX_INLIER_DISTANCE).mean(axis=1).argmin())
    return candidates[best], apart[best]
