"""Range scans of the points of one pair, their gaps, and free ranges as seen from a viewpoint on the base."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, ScanLimits, azimuths, fill_gaps, point_scan, seen_from
from tests.omnid.core.mapping.rooms import box, pose, scan_of

FLOOR_M = -1.2
VIEW = np.zeros(3)
LIMITS = ScanLimits((0.06, 1.7), np.radians(0.5), 6.0, 6)


def seen(*parts: np.ndarray, sigma_of_m2: float = 0.01) -> np.ndarray:
    """Return the scan of points, whose sigma is so many metres per square metre of range."""
    points = np.vstack(parts)
    above_floor = points - [0.0, 0.0, FLOOR_M]
    return point_scan(above_floor, sigma_of_m2 * (points**2).sum(axis=1), VIEW - [0.0, 0.0, FLOOR_M], LIMITS)


def arc(range_m: float, degrees: tuple[float, float], heights_m: tuple[float, float], count: int = 2000) -> np.ndarray:
    """Return points of an upright cylinder about the base."""
    rng = np.random.default_rng(1)
    angle, z = np.deg2rad(rng.uniform(*degrees, count)), rng.uniform(*heights_m, count)
    return np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle), z])


def floor(longest_m: float, degrees: tuple[float, float] = (-180, 180), z_m: float = FLOOR_M) -> np.ndarray:
    """Return points of the floor."""
    rng = np.random.default_rng(2)
    angle, r = np.deg2rad(rng.uniform(*degrees, 60_000)), rng.uniform(0.8, longest_m, 60_000)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(60_000, z_m)])


def within(low_deg: float, high_deg: float) -> np.ndarray:
    """Return which sectors lie between two azimuths."""
    degrees = np.rad2deg(azimuths())
    return (degrees > low_deg) & (degrees < high_deg)


def test_a_wall_is_found_at_its_range_and_elsewhere_nothing_is_known() -> None:
    scan = seen(arc(2.0, (-30, 30), (-0.8, 0.6)))
    np.testing.assert_allclose(scan[within(-29, 29)], 2.0, atol=1e-3)
    assert np.isnan(scan[~within(-32, 32)]).all()


def test_a_floor_with_noise_and_tilt_is_no_obstacle_at_any_range() -> None:
    rng = np.random.default_rng(3)
    ground = floor(6.0, z_m=-1.2)
    r = np.linalg.norm(ground, axis=1)
    noisy = ground * (1 + 0.01 * r * rng.standard_normal(len(r)))[:, None]
    tilted = noisy + np.outer(np.tan(np.deg2rad(0.7)) * ground[:, 0], [0, 0, 1])
    scan = seen(tilted)
    assert np.isfinite(scan).sum() <= 2


def test_a_box_before_a_wall_is_found_although_most_points_are_of_the_wall() -> None:
    scan = seen(arc(3.0, (-60, 60), (-0.9, 0.7), 20_000), arc(1.4, (-5, 5), (-0.9, -0.6), 150))
    np.testing.assert_allclose(scan[within(-4, 4)], 1.4, atol=0.02)
    np.testing.assert_allclose(scan[within(8, 50)], 3.0, atol=0.02)


@pytest.mark.parametrize(("gap", "far_m", "is_filled"), [(4, 3.0, True), (5, 3.0, False), (4, 5.0, False)])
def test_short_gaps_of_one_surface_are_filled(gap: int, far_m: float, is_filled: bool) -> None:
    """Across the seam between the last sector and the first."""
    ranges = np.full(SECTORS, 3.0, np.float32)
    ranges[gap - 2 : 90] = far_m
    ranges[[k % SECTORS for k in range(-2, gap - 2)]] = np.nan
    found = fill_gaps(ranges)
    assert np.isfinite(found[[-2, -1, 0, 1]]).all() == is_filled
    if is_filled:
        np.testing.assert_allclose(found, 3.0, rtol=1e-6)


def test_free_ranges_of_a_base_are_those_of_the_room_from_a_turned_viewpoint_on_it() -> None:
    """They are never longer, and at most 0.15 m shorter than those to flat walls."""
    room, T_base_view = box((-2.0, -1.5), (2.5, 1.5)), pose(0.2, -0.1, np.deg2rad(35))
    found = seen_from(scan_of(room, np.eye(4)), se3.inverse(T_base_view))
    true = scan_of(room, T_base_view)
    assert (found < true + 0.02).all() and (found > true - 0.15).all()
