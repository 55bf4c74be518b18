"""The floor's plane in panoramas of drawn floors and walls; brightness of the floor at places."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from omnid.core.mapping.range_scan import azimuths
from omnid.core.obstacles.floor_plane import END_M, FARTHEST_M, FloorPlane
from omnid.core.obstacles.floor_view import FloorCamera
from omnid.core.obstacles.observation import Observation, with_plane
from tests.omnid.core.obstacles.drawn_floor import (
    BASELINE_M,
    CYLINDER,
    HEIGHT_M,
    T_RECT_BASE,
    Pattern,
    panoramas,
    plain,
    worn,
)

VISIBLE = np.ones((CYLINDER.height, CYLINDER.width), bool)


def free_m(floor: Pattern, wall_m: float = 9.0, wall: Pattern = plain) -> np.ndarray:
    """Return the free ranges of drawn panoramas."""
    plane = FloorPlane(CYLINDER, T_RECT_BASE, BASELINE_M, VISIBLE)
    return plane.free_m(*panoramas(floor, wall_m, wall))


def test_a_floor_with_faint_stains_is_seen_and_a_plain_one_is_not() -> None:
    assert np.mean(free_m(worn) > FARTHEST_M - END_M - 0.2) > 0.95
    assert (free_m(plain) == 0).all()


@pytest.mark.parametrize("wall", [
    plain,
    lambda azimuth, z: 150 + 0 * z,
    lambda azimuth, z: 120 + 30 * np.sin(60 * azimuth),
    lambda azimuth, z: 120 + 15 * np.sin(9 * z) * np.sin(7 * azimuth + 4 * z),
], ids=["of the floor's colour", "brighter", "stripes", "texture"])
@pytest.mark.parametrize("wall_m", [1.3, 1.8])
def test_the_floor_ends_before_a_wall(wall_m: float, wall: Callable[..., np.ndarray]) -> None:
    free = free_m(worn, wall_m, wall)
    assert np.quantile(free, 0.98) < wall_m + 0.05 and np.median(free) > 0.55


def test_floor_is_seen_neither_in_the_dark_nor_where_the_robot_hides_it() -> None:
    assert (free_m(lambda x, y: 0.02 * worn(x, y)) == 0).all()
    masked = VISIBLE.copy()
    masked[:, : CYLINDER.width // 2] = False  # azimuths from 0 to pi
    plane = FloorPlane(CYLINDER, T_RECT_BASE, BASELINE_M, masked)
    free = plane.free_m(*panoramas(worn, 9.0, plain))
    assert (free[(azimuths() > 0.1) & (azimuths() < 3.0)] == 0).all() and np.median(free[azimuths() < -0.1]) > 2.0
    behind = panoramas(lambda x, y: np.where(np.hypot(x, y) < 1.6, 120.0, worn(x, y)), 9.0, plain)
    assert (FloorPlane(CYLINDER, T_RECT_BASE, BASELINE_M, VISIBLE).free_m(*behind) == 0).all(), "after a gap"
    nothing = FloorPlane(CYLINDER, T_RECT_BASE, BASELINE_M, np.zeros_like(VISIBLE))
    assert (nothing.free_m(*panoramas(worn, 9.0, plain)) == 0).all()


def test_an_obstacle_ends_the_floor_that_is_seen_otherwise() -> None:
    ranges = np.full(360, np.nan, np.float32)
    ranges[180] = 1.1
    seen = Observation(ranges, ranges, np.where(np.isfinite(ranges), ranges, 0.5).astype(np.float32))
    free = with_plane(seen, np.full(360, 2.0)).free_m
    assert free[180] == np.float32(1.1) and (np.delete(free, 180) == 2.0).all()


def test_the_view_of_the_floor_is_its_brightness_from_where_the_camera_sees_it_on() -> None:
    lower, _ = panoramas(lambda x, y: 100 + 20 * np.sin(2 * x) + 30 * np.cos(2 * y), 9.0, plain)
    camera = FloorCamera(CYLINDER, T_RECT_BASE)
    angle, distance = np.meshgrid(np.linspace(-3.1, 3.1, 40), np.linspace(0.85, 2.4, 20))
    places = np.column_stack([(distance * np.cos(angle)).ravel(), (distance * np.sin(angle)).ravel()])
    seen = camera.view(lower, VISIBLE, places)
    assert seen.in_view.all() and seen.noise_grey == lower.noise_grey
    np.testing.assert_allclose(seen.grey, 100 + 20 * np.sin(2 * places[:, 0]) + 30 * np.cos(2 * places[:, 1]), atol=4)
    nearest_m = CYLINDER.focal_px * HEIGHT_M / (CYLINDER.height - 1 - CYLINDER.row0)
    near = camera.view(lower, VISIBLE, np.array([[nearest_m - 0.05, 0.0], [nearest_m + 0.05, 0.0]]))
    assert near.in_view.tolist() == [False, True] and np.isnan(near.grey[0])
    assert not camera.view(lower, ~VISIBLE, places).in_view.any()
