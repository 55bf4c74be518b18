"""Integrals of the rates of a sensor over an interval, and the motion that wheels and gyro give."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.motion_filter import LONGEST_GAP_S, MOST_SAMPLES, RateHistory, SensedMotion


def history(times_s: list[float], rates: list[float]) -> RateHistory:
    found = RateHistory(1)
    found.add(np.array(times_s), np.array(rates)[:, None])
    return found


def test_rates_are_linear_between_samples_and_constant_after_the_last() -> None:
    found = history([0.0, 0.1, 0.2], [0.0, 1.0, 1.0]).integral(0.05, 0.25)
    assert found is not None
    assert found.amounts == pytest.approx([0.05 * 0.75 + 0.15]) and found.changes == pytest.approx([0.5])


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [(-0.01, 0.1), (0.2, 0.2), (0.0, 0.2 + LONGEST_GAP_S + 0.01), (0.0, 0.2 + LONGEST_GAP_S + 0.11)],
    ids=["before the first", "empty", "late", "later"],
)
def test_intervals_that_no_samples_cover_have_no_integral(start_s: float, end_s: float) -> None:
    samples = history([0.0, 0.1, 0.2], [1.0, 1.0, 1.0])
    assert samples.integral(0.0, 0.2) is not None and samples.integral(start_s, end_s) is None


def test_a_gap_between_samples_has_no_integral() -> None:
    samples = history([0.0, 0.1, 0.1 + LONGEST_GAP_S + 0.01], [1.0, 1.0, 1.0])
    assert samples.integral(0.0, 0.1) is not None and samples.integral(0.0, 0.2) is None


def test_samples_that_come_late_are_sorted_and_one_of_the_same_time_replaces_the_other() -> None:
    samples = history([0.2, 0.0], [1.0, 1.0])
    samples.add(np.array([0.1, 0.2]), np.array([[1.0], [3.0]]))
    found = samples.integral(0.1, 0.2)
    assert found is not None and found.amounts == pytest.approx([0.2])


def test_memory_is_bounded_and_the_newest_samples_stay() -> None:
    samples = history([0.01 * k for k in range(MOST_SAMPLES + 10)], [1.0] * (MOST_SAMPLES + 10))
    newest_s = 0.01 * (MOST_SAMPLES + 9)
    assert samples.integral(0.0, 0.05) is None and samples.integral(newest_s - 1, newest_s) is not None
    assert samples.missing_s(newest_s + 0.02) == pytest.approx(0.02) and samples.missing_s(newest_s - 1) == 0


def test_the_largest_difference_is_that_of_the_interval() -> None:
    samples = history([0.0, 0.1, 0.2], [9.0, 1.0, -2.0])
    assert samples.largest(0.1, 0.2, np.array([0.5])) == pytest.approx([2.5])
    assert samples.largest(0.3, 0.4, np.zeros(1)) is None


def test_a_motion_is_an_arc_with_both_kinds_of_errors() -> None:
    motion = SensedMotion(np.array([0.3, 0, 0, 0, 0, 0.2]), np.eye(6), 2 * np.eye(6), is_complete=True)
    assert np.array_equal(motion.covariance, 3 * np.eye(6))
    assert np.allclose(motion.T_prev_curr, se3.exp([0.3, 0, 0, 0, 0, 0.2]))
