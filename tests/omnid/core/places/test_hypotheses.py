"""Recognitions count once enough of them, in frames apart, give the same pose."""

from __future__ import annotations

import numpy as np

from calib import se3
from omnid.core.places.hypotheses import CONSISTENT, SURE_INLIERS, Hypotheses, Hypothesis
from omnid.core.places.recognition import Recognition
from tests.omnid.core.mapping.rooms import pose
from tests.omnid.core.scenery import Array

PLACE, NEWEST = 3, 9  # ids of keyframes: one of the map, one of the run
POSES = {PLACE: pose(5.0, 1.0, 0.5), NEWEST: pose(5.2, 1.1, 0.6)}
T_MAP_ODOM = pose(4.0, -1.0, 0.3)
COVARIANCE = np.diag([0.01] * 3 + [0.01] * 3) ** 2


def hypothesis(x_m: float, error_m: float = 0.0, inliers: int = 12) -> Hypothesis:
    """Return a recognition from a frame at x in odom, wrong by an error."""
    T_odom_rect = pose(x_m, 0.0, 0.0)
    T_map_rect = T_MAP_ODOM @ T_odom_rect @ pose(0.0, error_m, 0.0)
    found = Recognition(PLACE, se3.inverse(POSES[PLACE]) @ T_map_rect, COVARIANCE, inliers, 30, 4)
    return Hypothesis(found, NEWEST, np.eye(4), COVARIANCE, T_odom_rect)


def consistent(*given: Hypothesis, poses: dict[int, Array] = POSES) -> int:
    """Return how many agree at the last one of recognitions that are added in turn."""
    kept = Hypotheses()
    return [len(kept.add(one, poses)) for one in given][-1]


def test_recognitions_that_agree_count_once_they_are_enough() -> None:
    assert [consistent(*[hypothesis(0.1 * k) for k in range(n)]) for n in (1, 2, 3, 4)] == [0, 0, CONSISTENT, 4]


def test_one_that_contradicts_does_not_count() -> None:
    assert consistent(hypothesis(0.0), hypothesis(0.1, error_m=0.2), hypothesis(0.2)) == 0
    assert consistent(hypothesis(0.0), hypothesis(0.1, error_m=0.2), hypothesis(0.2), hypothesis(0.3)) == CONSISTENT


def test_a_robot_at_rest_needs_recognitions_with_more_inliers() -> None:
    assert consistent(*[hypothesis(0.0)] * 5) == 0
    assert consistent(*[hypothesis(0.0, inliers=SURE_INLIERS) for _ in range(3)]) == CONSISTENT
