"""Compiled solution of small systems of linear equations by Cholesky's method."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import inner

Array = NDArray[np.float64]


@inner
def factorise(H: Array, factor: Array) -> None:
    """Write the lower Cholesky factor of H (M, M), which may be the same array; NaN if H is not positive definite."""
    for a in range(len(H)):
        for b in range(a + 1):
            total = H[a, b]
            for c in range(b):
                total -= factor[a, c] * factor[b, c]
            factor[a, b] = math.sqrt(total) if a == b else total / factor[b, b]


@inner
def solve(factor: Array, g: Array, x: Array) -> None:
    """Write the solution of L L^T x = g for a lower factor L (M, M)."""
    size = len(g)
    for a in range(size):
        total = g[a]
        for c in range(a):
            total -= factor[a, c] * x[c]
        x[a] = total / factor[a, a]
    for a in range(size - 1, -1, -1):
        total = x[a]
        for c in range(a + 1, size):
            total -= factor[c, a] * x[c]
        x[a] = total / factor[a, a]


@inner
def write_inverse_cholesky(S: Array, W: Array) -> None:
    """Write the inverse (3, 3) of the lower Cholesky factor of S (3, 3), of which the lower triangle is read."""
    l00 = math.sqrt(S[0, 0])
    l10, l20 = S[1, 0] / l00, S[2, 0] / l00
    l11 = math.sqrt(S[1, 1] - l10 * l10)
    l21 = (S[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(S[2, 2] - l20 * l20 - l21 * l21)
    W[0, 0], W[1, 1], W[2, 2] = 1 / l00, 1 / l11, 1 / l22
    W[1, 0], W[2, 1] = -l10 * W[0, 0] * W[1, 1], -l21 * W[1, 1] * W[2, 2]
    W[2, 0] = -(l20 * W[0, 0] + l21 * W[1, 0]) * W[2, 2]
    W[0, 1], W[0, 2], W[1, 2] = 0.0, 0.0, 0.0
