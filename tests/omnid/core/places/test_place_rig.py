"""The part of a rig on which a map of places depends, and the comparison of two rigs by it."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib import se3
from calib.panorama import Cylinder
from omnid.core.places.place_rig import seen_by
from tests.omnid.formats.place_maps import RIG, some_places


def test_a_map_is_seen_by_the_same_rig_with_another_horizon_but_not_by_another_rig() -> None:
    places, shifted = some_places(2), dataclasses.replace(RIG, cylinder=Cylinder(1304, 380, 130.75))
    before = places.keyframes[1].features.views.copy()
    assert RIG.difference(shifted) == ""
    seen_by(places, RIG, shifted)
    np.testing.assert_allclose(places.keyframes[1].features.views - before, [[0, 2, 2]] * 256, atol=1e-4)
    smaller = dataclasses.replace(RIG, cylinder=Cylinder(1000, 378, 128.75))
    assert "panoramas of 1304 columns, not 1000" in RIG.difference(smaller)
    assert "0.2400 m, not 0.3000 m" in RIG.difference(dataclasses.replace(RIG, baseline_m=0.3))
    turned = dataclasses.replace(RIG, T_rig_rect=RIG.T_rig_rect @ se3.exp([0, 0, 0, 0, 0, 0.1]))
    assert "5.7 degrees" in RIG.difference(turned)
