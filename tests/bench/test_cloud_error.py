"""Distances of points from the surfaces of a world."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.simulation.rendering.surfaces import Rectangle, Scene
from tests.bench.cloud_error import distances_m

GREY = np.full((4, 4), 128, np.uint8)
# 2 m along x and 1 m down from (0, 0, 1), and a wall 5 m behind it.
SCENE = Scene(
    (
        Rectangle(np.array([0.0, 0, 1]), np.array([2.0, 0, 0]), np.array([0, 0, -1.0]), GREY),
        Rectangle(np.array([0.0, 5, 1]), np.array([2.0, 0, 0]), np.array([0, 0, -1.0]), GREY),
    )
)


@pytest.mark.parametrize(
    ("point", "distance_m"),
    [
        ((1.0, 0.0, 0.5), 0.0),
        ((1.0, 0.3, 0.5), 0.3),  # before it
        ((2.3, 0.0, 1.4), 0.5),  # beyond its corner
        ((1.0, 4.9, 0.5), 0.1),  # nearer to the other one
    ],
)
def test_a_point_is_as_far_as_its_nearest_surface(point: tuple[float, float, float], distance_m: float) -> None:
    assert distances_m(np.array([point]), SCENE)[0] == pytest.approx(distance_m, abs=1e-9)
