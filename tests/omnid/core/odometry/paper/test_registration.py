"""Motion between two clouds of the same points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.paper.registration import consensus, register
from tests.omnid.core.scenery import motion_errors

Array = NDArray[np.float64]


MOTION = se3.exp([0.1, -0.05, 0.02, 0.05, -0.1, 1.6])


def cloud(count: int, seed: int = 0) -> Array:
    """Points (N, 3) [m] on all sides."""
    return np.random.default_rng(seed).normal(0, 1.5, (count, 3))


def test_the_consensus_set_is_found_among_outliers() -> None:
    a = cloud(100)
    b = se3.apply(MOTION, a) + np.random.default_rng(1).normal(0, 0.005, (100, 3))
    b[:60] = cloud(60, 2)
    M, agree = consensus(a, b, np.random.default_rng(3), 0.05)
    assert agree[60:].mean() > 0.9 and agree[:60].sum() <= 3
    assert motion_errors(M, MOTION)[0] < 0.05
    assert not consensus(a[:2], b[:2], np.random.default_rng(3), 0.05)[1].any()


def test_gauss_newton_on_eq_9_finds_the_least_squares() -> None:
    """Exact without noise from a distant start; with noise no small motion makes the sum smaller."""
    a = cloud(40)
    exact = register(a, se3.apply(MOTION, a), MOTION @ se3.exp(np.full(6, 0.1)))
    np.testing.assert_allclose(exact.M, MOTION, atol=1e-8)
    b = se3.apply(MOTION, a) + np.random.default_rng(4).normal(0, 0.05, a.shape)
    M = register(a, b, MOTION).M
    least = ((b - se3.apply(M, a)) ** 2).sum()
    for axis in np.vstack([np.eye(6), -np.eye(6)]):
        assert ((b - se3.apply(se3.exp(1e-4 * axis) @ M, a)) ** 2).sum() > least
