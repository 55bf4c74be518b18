"""Range scans from points: the nearest obstacle of each sector, false points, heights, gaps."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.range_scan import MAX_RANGE_M, SECTORS, azimuths, range_scan
from tests.omnid.core.mapping.rooms import box, pose, scan_of

HEIGHTS = (-0.5, 0.5)


def wall_points(ranges: np.ndarray, z: float, rng: np.random.Generator, per_sector: int = 12) -> np.ndarray:
    """Return points (N, 3) around the ranges (SECTORS,) of a scan, at one height."""
    angle = np.repeat(azimuths(), per_sector) + rng.uniform(-0.5, 0.5, SECTORS * per_sector) * 2 * np.pi / SECTORS
    r = np.repeat(ranges, per_sector)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(len(r), z)])


def test_a_room_is_measured_in_all_directions() -> None:
    exact = scan_of(box((-3.0, -2.0), (4.0, 2.5)), pose(0.5, 0.3, 0.7))
    found = range_scan(wall_points(exact, 0.1, np.random.default_rng(1)), HEIGHTS)
    np.testing.assert_allclose(found, exact, rtol=0.02)


def test_floor_and_ceiling_are_no_obstacles() -> None:
    rng = np.random.default_rng(2)
    wall = wall_points(np.full(SECTORS, 3.0), 0.4, rng)
    others = [wall_points(np.full(SECTORS, 1.0), z, rng) for z in (-0.6, 0.6)]
    np.testing.assert_allclose(range_scan(np.vstack([wall, *others]), HEIGHTS), 3.0, rtol=1e-6)


def test_single_false_points_in_front_of_a_wall_do_not_count() -> None:
    rng = np.random.default_rng(3)
    wall, false = wall_points(np.full(SECTORS, 3.0), 0.0, rng), wall_points(np.full(SECTORS, 1.0), 0.0, rng, 2)
    np.testing.assert_allclose(range_scan(np.vstack([wall, false]), HEIGHTS), 3.0, rtol=1e-6)


def test_sectors_without_enough_points_are_unknown() -> None:
    rng = np.random.default_rng(4)
    assert np.isnan(range_scan(wall_points(np.full(SECTORS, 3.0), 0.0, rng, 2), HEIGHTS)).all()
    assert np.isnan(range_scan(np.zeros((0, 3)), HEIGHTS)).all()
    assert np.isnan(range_scan(wall_points(np.full(SECTORS, MAX_RANGE_M + 1), 0.0, rng), HEIGHTS)).all()


@pytest.mark.parametrize(("gap", "far_m", "is_filled"), [(4, 3.0, True), (5, 3.0, False), (4, 5.0, False)])
def test_short_gaps_of_one_surface_are_filled(gap: int, far_m: float, is_filled: bool) -> None:
    """Across the seam between the last sector and the first."""
    ranges = np.full(SECTORS, 3.0)
    ranges[gap - 2 : 90] = far_m
    points = wall_points(ranges, 0.0, np.random.default_rng(5)).reshape(SECTORS, -1, 3)
    points[[k % SECTORS for k in range(-2, gap - 2)]] = np.nan
    found = range_scan(points.reshape(-1, 3), HEIGHTS)
    assert np.isfinite(found[[-2, -1, 0, 1]]).all() == is_filled
    if is_filled:
        np.testing.assert_allclose(found, 3.0, rtol=1e-6)
