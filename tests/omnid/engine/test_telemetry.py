"""Telemetry: quantiles within 2 % in constant memory, counters of stages."""

from __future__ import annotations

import math
import sys
import threading

import numpy as np
import pytest

from omnid.engine.telemetry import Histogram, StageStats, Telemetry
from omnid.errors import OmnidError


def test_quantiles_are_within_two_per_cent_over_nine_decades() -> None:
    for duration_s in np.geomspace(1.001e-6, 999.0, 200).tolist():
        histogram = Histogram()
        for value_s in (duration_s, duration_s, 1e4):
            histogram.add(value_s)
        assert histogram.p(0.5) == pytest.approx(duration_s, rel=0.02)


def test_quantiles_agree_with_sorting() -> None:
    durations_s = np.random.default_rng(1).lognormal(-5.0, 2.0, 5000)
    histogram = Histogram()
    for duration_s in durations_s:
        histogram.add(float(duration_s))
    for q in (0.0, 0.01, 0.5, 0.9, 0.99, 0.999):
        expected = np.quantile(durations_s, q, method="inverted_cdf")
        assert histogram.p(q) == pytest.approx(expected, rel=0.02)
    assert histogram.p(1.0) == histogram.max_s == durations_s.max()
    assert histogram.mean_s == pytest.approx(durations_s.mean())
    assert histogram.count == 5000


def test_counts_durations_out_of_range() -> None:
    histogram = Histogram()
    for duration_s in (0.0, 1e-9, 1e9, math.inf):
        histogram.add(duration_s)
    assert histogram.count == 4
    assert histogram.p(0.5) == 1e-6
    assert histogram.p(0.75) == pytest.approx(1e3, rel=0.02)
    assert histogram.p(1.0) == math.inf


def test_an_empty_histogram_returns_nan() -> None:
    histogram = Histogram()
    assert all(math.isnan(value) for value in (histogram.p(0.5), histogram.mean_s, histogram.max_s))


@pytest.mark.parametrize("q", [-0.1, 1.1, 99, math.nan])
def test_refuses_a_quantile_that_is_no_fraction(q: float) -> None:
    with pytest.raises(ValueError, match="fraction"):
        Histogram().p(q)


def test_memory_is_constant() -> None:
    histogram = Histogram()
    before = sys.getsizeof(histogram._bins)
    for k in range(10_000):
        histogram.add(1e-5 * k)
    assert sys.getsizeof(histogram._bins) == before < 10_000


def test_measures_wall_and_thread_time() -> None:
    stats = StageStats("sleep")
    assert stats.timed(lambda seconds: threading.Event().wait(seconds), 0.02) is False
    assert stats.processed == stats.wall.count == stats.cpu.count == 1
    assert stats.wall.max_s > stats.cpu.max_s  # a wait costs time but no work


def test_does_not_count_a_call_that_raises() -> None:
    stats = StageStats("broken")
    with pytest.raises(ZeroDivisionError):
        stats.timed(lambda: 1 / 0)
    assert stats.processed == stats.wall.count == 0


def test_counts_the_messages_of_a_source_without_its_end() -> None:
    stats = StageStats("source")
    assert list(stats.timed_each("abc")) == ["a", "b", "c"]
    assert stats.processed == stats.wall.count == 3


def test_summary_has_a_row_per_stage_in_milliseconds() -> None:
    telemetry = Telemetry()
    stats = telemetry.add(StageStats("stereo", processed=2, dropped=1))
    telemetry.add(StageStats("idle"))
    stats.wall.add(0.010)
    stats.wall.add(0.030)
    stereo, idle = telemetry.summary()
    assert stereo[:3] == ("stereo", 2, 1)
    assert stereo[3:] == pytest.approx((10.0, 30.0, 30.0), rel=0.02)
    assert idle[:3] == ("idle", 0, 0)
    assert all(map(math.isnan, idle[3:]))


def test_refuses_a_name_in_use() -> None:
    telemetry = Telemetry()
    telemetry.add(StageStats("stereo"))
    with pytest.raises(OmnidError, match="stereo"):
        telemetry.add(StageStats("stereo"))
