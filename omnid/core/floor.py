"""The plane of the floor below the cameras, from the points of stereo.

About the lower viewpoint, in the axes of the base, the floor is z = -h + a x + b y. With the residual
e_i = z_i + h - a x_i - b y_i and its noise sigma_i, a point within a span S of the floor has the density

    p N(e_i; sigma_i) + (1 - p) ((1 - FALSE) Phi(e_i / sigma_i) + FALSE) / S

A share p of the points lies on the floor, the others above it, evenly over S (walls, furniture), and a few are false.
So few may lie below: the top of a table is not a floor. The prior of a and b is 0 +- 1 degree. h is searched on a
grid, with S = h; then expectation maximisation (Dempster, Laird, Rubin 1977) finds h, a, b, p and the noise's scale,
with S = SPAN_M. The evidence for a floor is the log of the ratio of the likelihoods with it (p) and without (p = 0).
Points of one surface share their errors: CORRELATED_POINTS of them count as one. The evidence of pairs adds up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.least_squares import SIGMA_PER_MAD

Array = NDArray[np.float64]

TILT_SIGMA_RAD: Final = math.radians(1.0)  # prior of the tilt of a base on its wheels
# Heights of cameras on robots, which are searched; the step is finer than the noise that the prior of the tilt adds.
HEIGHTS_M: Final = np.arange(0.1, 3.0, 0.02)
SPAN_M: Final = 0.3  # Points within this distance of the floor are fitted: 3 sigma of the noisiest ones.
FALSE: Final = 0.05  # Share of the points that lie on no surface, false matches.
# Share of the points on the floor at the start of the search: that of a narrow corridor.
FIRST_PART: Final = 0.1
# Least slope of rays below the horizon, because flatter ones measure the height of the floor badly.
STEEP: Final = math.tan(math.radians(15))
LARGEST_SIGMA_M: Final = 0.1  # Noisier points are left out: their weight is below a 400th of that of the best.
UNEVEN_M: Final = 0.005  # Standard deviation of an uneven floor.
NOISE_SCALES: Final = (0.25, 1.0)  # limits of the factor on the stated noise; measured on floors: 0.3 to 0.9
MAX_POINTS: Final = 2000  # of a pair: more would cost time and change nothing
# Of the 36 floors of test_floor.py, 2000 iterations move 34 by 3 mm at most, and reject 2.
ITERATIONS: Final = 40
CONVERGED: Final = 1e-5  # m, rad: a step below a 300th of RIG_SIGMAS ends the search
# Points of one surface that count as one; fitted on rendered logs, whose pairs scatter by 6 mm and 0.3 degrees.
CORRELATED_POINTS: Final = 20.0
MIN_EVIDENCE: Final = 5.0  # Log-likelihood ratio from which a run has a floor: odds of 150 to 1.
MIN_PAIR_EVIDENCE: Final = 0.5  # a pair with less shows no floor
# Sectors of ten degrees. The floor must be seen in a third of them, because fewer determine its tilt badly.
SECTORS: Final = 36
MIN_SECTORS: Final = 12
# Errors [m, rad, rad] of the rig and of stereo, which many pairs do not average out; measured: -12 to +8 mm.
RIG_SIGMAS: Final = np.array([0.01, math.radians(0.2), math.radians(0.2)])
# Pairs whose heights scatter by more show no common floor; those of one floor scatter by 6 mm.
LARGEST_SCATTER_M: Final = 0.05


class Floor(NamedTuple):
    """The plane z = -height_m + a x + b y about the lower viewpoint in base axes; sigmas of height and of a and b."""

    height_m: float
    a: float = 0.0
    b: float = 0.0
    sigma_m: float = 0.0
    sigma_rad: float = 0.0

    @property
    def tilt_rad(self) -> float:
        """Angle between the floor's normal and z of the base."""
        return math.atan(math.hypot(self.a, self.b))

    def T_floor_base(self, view: Array) -> Array:
        """Return the transform (4, 4) from the base to its level frame: z is the height above the floor, the origin
        below or above that of the base. view (3,): the lower viewpoint in the base frame.
        """
        up = np.array([-self.a, -self.b, 1.0]) / math.hypot(self.a, self.b, 1.0)
        R = se3.rotation_exp(np.array([up[1], -up[0], 0.0]) * (self.tilt_rad / max(math.hypot(up[0], up[1]), 1e-12)))
        return se3.transform(R, np.array([0.0, 0.0, self.height_m * up[2] - up @ view]))


class FloorFit(NamedTuple):
    """The floor of one pair, and the evidence for it."""

    floor: Floor
    evidence: float


def fit_floor(points: Array, variance_m2: Array) -> FloorFit | None:
    """Return the floor among points (N, 3) [m] about the lower viewpoint in base axes; None where it is not seen.

    variance_m2 (N,): along the rays.
    """
    # 1. The points far enough below the horizon whose noise along z is small enough, at most MAX_POINTS.
    across, fall = np.hypot(points[:, 0], points[:, 1]), -points[:, 2]
    steep = (fall > HEIGHTS_M[0]) & (fall > STEEP * across)
    xyz, fall, across = points[steep], fall[steep], across[steep]
    sigma_m = np.hypot(np.sqrt(variance_m2[steep]) * fall / np.hypot(across, fall), UNEVEN_M)
    kept = np.flatnonzero(sigma_m < LARGEST_SIGMA_M)  # False for NaN
    kept = kept[:: max(1, -(-len(kept) // MAX_POINTS))]
    xyz, sigma_m, across = xyz[kept], sigma_m[kept], across[kept]
    if len(xyz) < SECTORS:
        return None
    # 2. The likeliest height of a level floor; its tilt is noise that grows with the range.
    heights_m = HEIGHTS_M[:, None]
    on, off = _densities(xyz[:, 2] + heights_m, np.hypot(sigma_m, TILT_SIGMA_RAD * across), heights_m)
    best = np.log(FIRST_PART * on + (1 - FIRST_PART) * off).sum(axis=1).argmax()
    # 3. Height, tilt, part on the floor and noise, by the points about the floor.
    A = np.column_stack([-np.ones(len(across)), xyz[:, :2]])
    q, part, scale = np.array([HEIGHTS_M[best], 0.0, 0.0]), FIRST_PART, 1.0
    prior = np.diag([0.0, TILT_SIGMA_RAD**-2, TILT_SIGMA_RAD**-2])
    for _ in range(ITERATIONS):
        e = xyz[:, 2] - A @ q
        near = np.abs(e) < SPAN_M
        on, off = _densities(e, scale * sigma_m, SPAN_M)
        share = np.where(near, part * on / (part * on + (1 - part) * off), 0.0)
        weight = share / (scale * sigma_m) ** 2 / CORRELATED_POINTS
        information = A.T @ (weight[:, None] * A) + prior
        total, before = float(share.sum()), q
        if total < 1.0:
            return None
        q = np.linalg.solve(information, A.T @ (weight * xyz[:, 2]))
        part = total / int(near.sum())
        scale = float(np.clip(math.sqrt(share @ ((xyz[:, 2] - A @ q) / sigma_m) ** 2 / total), *NOISE_SCALES))
        if np.abs(q - before).max() < CONVERGED:
            break
    # 4. The evidence, and the directions in which the floor is seen.
    evidence = float(np.log((part * on + (1 - part) * off) / off)[near].sum()) / CORRELATED_POINTS
    x, y = xyz[share > 0.5, :2].T
    sectors = len(np.unique(np.floor(np.arctan2(y, x) * (SECTORS / (2 * math.pi)))))
    if evidence < MIN_PAIR_EVIDENCE or sectors < MIN_SECTORS or q[0] < HEIGHTS_M[0]:
        return None
    sigma = np.hypot(np.sqrt(np.diag(np.linalg.inv(information))), RIG_SIGMAS)
    return FloorFit(Floor(float(q[0]), float(q[1]), float(q[2]), float(sigma[0]), float(sigma[1:].max())), evidence)


def _densities(e: Array, sigma_m: Array, span_m: float | Array) -> tuple[Array, Array]:
    """Return the densities of points with residuals e [m], if they are on the floor and if they are not."""
    x = e / sigma_m
    on = np.exp(-0.5 * x * x) / (math.sqrt(math.tau) * sigma_m)
    # Phi(x) with an error of 3e-4 at most (Page 1977): numpy has no error function, and scipy's takes long to load.
    below = 0.5 * (1 + np.tanh(math.sqrt(2 / math.pi) * x * (1 + 0.044715 * x * x)))
    return on, ((1 - FALSE) * below + FALSE) / span_m


def common_floor(pairs: Iterable[tuple[Array, Array]]) -> Floor | None:
    """Return the median of the floors that pairs show (see `fit_floor`); None: not seen, or they contradict each other.

    Errors of pairs are not independent: their number makes the sigma no smaller than that of one pair.
    """
    found = [fit for points, variance_m2 in pairs if (fit := fit_floor(points, variance_m2)) is not None]
    if sum(fit.evidence for fit in found) <= MIN_EVIDENCE:
        return None
    fits = np.array([fit.floor for fit in found])
    middle = np.median(fits, axis=0)
    scatter = SIGMA_PER_MAD * np.median(np.abs(fits - middle), axis=0)
    if scatter[0] > LARGEST_SCATTER_M:
        return None
    height_m, a, b, sigma_m, sigma_rad = middle.tolist()
    return Floor(height_m, a, b, math.hypot(sigma_m, scatter[0]), math.hypot(sigma_rad, scatter[1:3].max()))
