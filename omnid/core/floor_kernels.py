"""Densities of points on the floor and of all others, compiled (core/floor.py)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Array = NDArray[np.float64]


@inner
def _both(e: float, sigma_m: float, span_m: float, false: float) -> tuple[float, float]:
    """Return the densities of a point with residual e, if it is on the floor and if it is not."""
    x = e / sigma_m
    on = math.exp(-0.5 * x * x) / (math.sqrt(2 * math.pi) * sigma_m)
    below = 0.5 * math.erfc(-x / math.sqrt(2.0))  # Phi(x)
    return on, ((1 - false) * below + false) / span_m


@compiled("(f8[::1], f8[::1], f8, f8, f8[:, ::1])", writes=("found",))
def densities(e: Array, sigma_m: Array, span_m: float, false: float, found: Array) -> None:
    """Write the densities (2, N) of points with residuals e (N,) on the floor, and of others; false: the part of
    false matches.
    """
    for i in range(len(e)):
        found[0, i], found[1, i] = _both(e[i], sigma_m[i], span_m, false)


@compiled("(f8[::1], f8[::1], f8[::1], f8, f8, f8[::1])", writes=("found",))
def level_floors(z_m: Array, sigma_m: Array, heights_m: Array, part: float, false: float, found: Array) -> None:
    """Write the log likelihoods (H,) of points at z (N,) with level floors at heights (H,) below the viewpoint.

    part: of the points that lie on the floor; a height is the span of the others.
    """
    for row in range(len(heights_m)):
        total = 0.0
        for i in range(len(z_m)):
            on, off = _both(z_m[i] + heights_m[row], sigma_m[i], heights_m[row], false)
            total += math.log(part * on + (1 - part) * off)
        found[row] = total
