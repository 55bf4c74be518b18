"""Bounds of what is published of a pose that is not known."""

from __future__ import annotations

import numpy as np

from omnid.core.odometry.estimates import MOST_SIGMA, bounded


def test_a_covariance_stays_within_what_a_pose_may_be_off_and_keeps_its_correlations() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6)) * np.repeat([1e5, 0.1], 3)[:, None]
    P = root @ root.T
    found = bounded(P)
    assert (np.sqrt(np.diag(found)) <= MOST_SIGMA * (1 + 1e-12)).all() and np.linalg.eigvalsh(found).min() > -1e-6
    sigma, before = np.sqrt(np.diag(found)), np.sqrt(np.diag(P))
    np.testing.assert_allclose(found / np.outer(sigma, sigma), P / np.outer(before, before), atol=1e-9)
    small = 1e-8 * P
    assert bounded(small).tobytes() == small.tobytes(), "a smaller one is the same"
    assert (bounded(np.zeros((6, 6))) == 0).all()
