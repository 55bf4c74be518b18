"""Dense depth of pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omnid.config import Config
from omnid.messages import Panoramas
from omnid.stages.dense_depths import DenseStereo
from omnid.stages.geometry import geometry
from tests.omnid.core.scenery import texture, wrapped
from tests.simulation import make_rig

CONFIG = Config()


@pytest.mark.parametrize(("min_range_m", "found"), [(0.5, True), (3.0, False)])
def test_the_search_reaches_the_nearest_points(min_range_m: float, found: bool) -> None:
    """A wall whose disparity is 60 px stands 0.6 m away."""
    rig_geometry = geometry(make_rig(size=768, baseline_m=0.2), CONFIG.panorama)
    shape = (rig_geometry.cylinder.height, rig_geometry.cylinder.width)
    lower = texture(1, shape, sigma_px=3)
    upper = np.roll(lower, 60, axis=0)
    inner = np.zeros(shape, bool)
    inner[10:-80] = True
    depth = DenseStereo(rig_geometry, replace(CONFIG.stereo, min_range_m=min_range_m)).compute(
        Panoramas(0, 0, wrapped(lower), wrapped(upper), inner)
    )
    right = np.abs(depth.disparity - 60) < 1
    assert (right.sum() > 5000) == found
