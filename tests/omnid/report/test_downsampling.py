"""Downsampling of long series without loss of spikes."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from omnid.report.downsampling import BINS, Corner, Downsampled, path_trace


def test_few_values_are_kept() -> None:
    series = Downsampled()
    points = [(0.1 * k, math.sin(k)) for k in range(BINS)]
    for t_s, value in reversed(points):
        series.add(t_s, value)
    assert series.points() == points
    assert series.count == BINS and series.newest == 0.0


def test_spikes_survive_any_length() -> None:
    series, rng = Downsampled(), np.random.default_rng(1)
    values = rng.normal(0, 0.01, 100_000)
    values[33_333], values[77_777] = 5.0, -3.0
    for k, value in enumerate(values):
        series.add(k / 30, float(value))
    points = series.points()
    assert len(points) <= 2 * BINS and points == sorted(points)
    assert (33_333 / 30, 5.0) in points and (77_777 / 30, -3.0) in points
    assert len({int(t // 100) for t, _ in points}) == 34  # nowhere a hole


def test_invalid_values_are_left_out() -> None:
    series = Downsampled()
    for value in (math.nan, math.inf, -math.inf, 1e300):
        series.add(0.0, value)
    series.add(math.nan, 1.0)
    series.add(1e300, 1.0)
    assert series.count == 0 and series.points() == []


def test_scattered_times_stay_within_bounds() -> None:
    series = Downsampled()
    for t_s in np.random.default_rng(2).uniform(-1e9, 1e9, 3000):
        series.add(float(t_s), 1.0)
    assert len(series.points()) <= 2 * BINS


@pytest.mark.parametrize("moment", [12_345, 12_346, 12_347])
def test_path_keeps_corners_and_the_worst_state_between(moment: int) -> None:
    trace = path_trace()
    for k in range(20_000):
        rank = 2 if k == moment else 0
        trace.add(Corner(0.02 * min(k, 10_000), 0.02 * max(0, k - 10_000), 0.1 * k, rank))
    corners = trace.with_end()
    assert 1000 < len(corners) <= 4001
    assert corners[0][:2] == (0.0, 0.0) and corners[-1][:2] == (200.0, 0.02 * 9999)
    assert max(math.dist(a[:2], b[:2]) for a, b in pairwise(corners)) < 0.5
    lost = [corner for corner in corners if corner.rank == 2]
    assert len(lost) == 1 and abs(lost[0].t_s - 0.1 * moment) < 2.0


def test_standing_still_is_one_place() -> None:
    trace = path_trace()
    for k in range(50_000):
        trace.add(Corner(0.001 * (k % 2), 0.0, float(k), k % 3))
    assert len(trace.with_end()) == 2 and trace.with_end()[-1].t_s == 49_999.0
