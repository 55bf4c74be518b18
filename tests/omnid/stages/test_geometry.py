"""Times of exposure of a rig's file reach the panoramas; the configuration's own replace them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.rig import ShutterTimes
from omnid.camera_config import TimingConfig
from omnid.config import PanoramaConfig
from omnid.messages import FramePair
from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry


@pytest.mark.parametrize(
    ("config", "delay_s", "line_s"),
    [
        (TimingConfig(), 8e-3, 2e-5),
        (TimingConfig(upper_delay_ms=3.0), 3e-3, 2e-5),
        (TimingConfig(line_time_us=30.0), 8e-3, 3e-5),
    ],
)
def test_times_of_the_rig_unless_the_configuration_has_others(
    config: TimingConfig, delay_s: float, line_s: float
) -> None:
    rig = replace(make_rig(size=128), times=ShutterTimes(8e-3, 2e-5))
    dark = np.zeros((128, 128), np.uint8)
    seen = Dewarp(geometry(rig, PanoramaConfig()), PanoramaConfig(), config).process(FramePair(0, 0, dark, dark, 1e-3))
    assert seen.times.lower_rows_s.size
    assert seen.times.skew_s == pytest.approx(1e-3 + delay_s)
    assert seen.times.lower_rows_s.max() == pytest.approx(line_s * 127, rel=0.1)
