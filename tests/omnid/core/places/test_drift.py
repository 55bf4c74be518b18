"""Loops show how much more odometry drifts than its covariance says."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.places.drift import drift_factor, relative_covariance

BY_ODOMETRY = np.broadcast_to(np.diag([1e-4] * 3 + [1e-6] * 3), (60, 6, 6))
BY_LOOP = np.broadcast_to(np.diag([1e-6] * 3 + [1e-8] * 3), (60, 6, 6))


@pytest.mark.parametrize("factor", [1.0, 25.0, 2500.0])
def test_the_factor_explains_the_errors(factor: float) -> None:
    rng = np.random.default_rng(3)
    errors = rng.multivariate_normal(np.zeros(6), factor * BY_ODOMETRY[0] + BY_LOOP[0], 60)
    found = drift_factor(errors, BY_ODOMETRY, BY_LOOP)
    assert factor / 1.6 < found < 1.6 * factor


def test_odometry_is_never_trusted_more_than_it_says() -> None:
    assert drift_factor(np.zeros((60, 6)), BY_ODOMETRY, BY_LOOP) == 1.0
    assert drift_factor(np.zeros((0, 6)), BY_ODOMETRY[:0], BY_LOOP[:0]) == 1.0


def test_a_relative_covariance_is_what_was_added_on_the_way() -> None:
    T_a_b, added = se3.exp([2.0, 0, 0, 0, 0, 1.0]), np.diag([1e-4, 2e-4, 1e-4, 1e-6, 1e-6, 3e-6])
    of_a = np.diag([1e-3, 2e-3, 1e-3, 1e-5, 1e-5, 2e-5])
    A = se3.adjoint(se3.inverse(T_a_b))
    np.testing.assert_allclose(relative_covariance(T_a_b, of_a, A @ of_a @ A.T + added), added, atol=1e-12)
    shrunk = relative_covariance(T_a_b, of_a, 0.5 * A @ of_a @ A.T)
    assert np.linalg.eigvalsh(shrunk).min() > -1e-15
