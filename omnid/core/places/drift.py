"""Drift of odometry, as the loops show it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]

# Share of the squared distances that the factor explains, because the others may be wrong loops.
QUANTILE: Final = 0.75
EXPECTED: Final = 7.841  # that quantile of the chi-squared distribution of six dimensions; exact
LARGEST: Final = 1e6  # factor on the covariance, so that sigmas grow a thousandfold at most
ROUNDS: Final = 40  # Rounds of bisection, so that the factor is exact to 2^-40 of its range.


def relative_covariance(T_a_b: Array, of_a: Array, of_b: Array) -> Array:
    """Return the covariance (..., 6, 6) of T_a_b for poses whose covariances grow along the path from a to b.

    What b has beyond a; its negative part, where the estimate of b became better than that of a, is left out.
    """
    A = se3.adjoint(se3.inverse(T_a_b))
    grown = of_b - A @ of_a @ np.swapaxes(A, -1, -2)
    values, vectors = np.linalg.eigh((grown + np.swapaxes(grown, -1, -2)) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def drift_factor(errors: Array, by_odometry: Array, by_loop: Array) -> float:
    """Return the factor >= 1 on odometry's covariance that explains the errors (N, 6) of loops.

    errors: log of T_a_b by odometry in that by the loop; by_odometry, by_loop (N, 6, 6) their covariances. The factor
    is the one at which a quantile of the squared Mahalanobis distances is that of the distribution: noise of the images
    is in odometry's covariance, an error of the rig is not.
    """

    def squared(factor: float) -> float:
        S = factor * by_odometry + by_loop
        return float(np.quantile((errors * np.linalg.solve(S, errors[:, :, None])[:, :, 0]).sum(axis=1), QUANTILE))

    if not len(errors) or squared(1.0) <= EXPECTED:
        return 1.0
    low, high = 0.0, float(np.log(LARGEST))
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        low, high = (middle, high) if squared(float(np.exp(middle))) > EXPECTED else (low, middle)
    return float(np.exp(high))
