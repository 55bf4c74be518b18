"""Brightness of mirror images where the panoramas show them."""

from __future__ import annotations

import numpy as np
import pytest

from calib.panorama import fit_cylinder
from calib.rig import Rig
from omnid.light.exposure_law import UsefulArea
from omnid.messages import FramePair
from tests.simulation.recipes import mild_rig


@pytest.fixture(scope="module")
def rig() -> Rig:
    return mild_rig(3, 240)


@pytest.fixture(scope="module")
def area(rig: Rig) -> UsefulArea:
    return UsefulArea(rig, fit_cylinder(rig))


def test_measures_where_the_panorama_is(rig: Rig, area: UsefulArea) -> None:
    pair = []
    for mounted in (rig.lower, rig.upper):
        image = np.full((240, 240), 255, np.uint8)
        v, u = np.mgrid[:240, :240]
        pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
        image.ravel()[mounted.visible.contains(pixels)] = 50
        pair.append(image)
    lower, upper = area.levels(FramePair(0, 0, pair[0], pair[1] // 2))
    assert (lower.mean, lower.bright) == (50, 50) and (upper.mean, upper.bright) == (25, 25)
