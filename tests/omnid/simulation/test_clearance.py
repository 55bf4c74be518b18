"""Distance of a disc from what stands in its world."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.simulation.clearance import clearance_m, footprints
from omnid.simulation.rendering.shapes import box
from omnid.simulation.rendering.surfaces import Rectangle

RNG = np.random.default_rng(1)


def upright(height_m: float, from_m: float = 0.0) -> Rectangle:
    """Return a wall along x from 0 to 2 at y 1."""
    top = np.array([0.0, 1.0, from_m + height_m])
    return Rectangle(top, np.array([2.0, 0, 0]), np.array([0, 0, -height_m]), np.zeros((8, 8), np.uint8), "wall")


@pytest.mark.parametrize("wall", [upright(0.01), upright(1.0, from_m=0.6)], ids=["a sill", "above the robot"])
def test_what_is_driven_over_or_under_has_no_footprint(wall: Rectangle) -> None:
    assert (
        footprints([wall], 0.5).shape == (0, 2, 2) and clearance_m(footprints([wall], 0.5), (1.0, 1.0), 0.2) == np.inf
    )


def test_the_distance_is_that_of_the_nearest_point_from_the_outline() -> None:
    segments = footprints([upright(1.0)], 0.5)
    assert clearance_m(segments, (1.0, 0.0), 0.2) == pytest.approx(0.8)
    assert clearance_m(segments, (3.0, 1.0), 0.2) == pytest.approx(0.8) and clearance_m(segments, (1.0, 0.9), 0.2) < 0
    around = footprints(box(RNG, (5.0, 5.0), (1.0, 1.0, 0.5), 0.0), 0.4)
    assert clearance_m(around, (5.0, 3.5), 0.2) == pytest.approx(0.8)
