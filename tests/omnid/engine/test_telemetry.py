"""Telemetry: quantiles within 5 %, and the summary of stages."""

from __future__ import annotations

import math

import numpy as np
import pytest

from omnid.engine.telemetry import Histogram, StageStats, Telemetry
from omnid.errors import OmnidError


@pytest.mark.parametrize("centre", [-10.0, -5.0, 4.0])
def test_quantiles_agree_with_sorting(centre: float) -> None:
    durations_s = np.random.default_rng(1).lognormal(centre, 0.7, 5000)
    histogram = Histogram()
    for duration_s in durations_s.tolist():
        histogram.add(duration_s)
    expected = np.quantile(durations_s, [0.0, 0.01, 0.5, 0.9, 0.99], method="inverted_cdf")
    assert histogram.quantiles(0.0, 0.01, 0.5, 0.9, 0.99) == pytest.approx(expected, rel=0.05)
    assert histogram.p(1.0) == histogram.max_s == durations_s.max()
    assert histogram.count == 5000


def test_summary_has_a_row_per_stage_in_milliseconds() -> None:
    telemetry = Telemetry()
    stats = telemetry.add(StageStats("stereo", processed=2, dropped=1))
    telemetry.add(StageStats("idle"))
    stats.wall.add(0.010)
    stats.wall.add(0.030)
    stereo, idle = telemetry.summary()
    assert stereo[:3] == ("stereo", 2, 1) and stereo[3:] == pytest.approx((10.0, 30.0, 30.0), rel=0.05)
    assert idle[:3] == ("idle", 0, 0) and all(map(math.isnan, idle[3:]))
    with pytest.raises(OmnidError, match="stereo"):
        telemetry.add(StageStats("stereo"))
