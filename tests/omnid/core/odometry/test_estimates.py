"""Bounds of what is published of a pose that is not known, and landmarks that support a prediction."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.estimates import MOST_SIGMA, PoseEstimate, bounded, supports


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


@pytest.mark.parametrize(
    ("moved_m", "turned_deg", "inliers", "supported"),
    [(0.0, 0.0, 12, True), (0.09, 9.0, 7, True), (0.11, 0.0, 12, False), (0.0, 11.0, 12, False), (0.0, 0.0, 6, False)],
)
def test_few_landmarks_support_a_prediction_where_most_of_them_show_it(
    moved_m: float, turned_deg: float, inliers: int, supported: bool
) -> None:
    T_predicted = se3.exp([1.0, 2.0, 0.0, 0.0, 0.0, 0.5])
    found = T_predicted @ se3.exp([moved_m, 0.0, 0.0, 0.0, 0.0, np.radians(turned_deg)])
    assert supports(PoseEstimate(found, np.eye(6), 20, 12, inliers), T_predicted) == supported
    assert not supports(None, T_predicted)
