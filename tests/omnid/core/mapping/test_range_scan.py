"""Gaps of range scans, and free ranges as seen from a viewpoint on the base."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.mapping.range_scan import SECTORS, azimuths, fill_gaps, seen_from
from tests.omnid.core.mapping.rooms import box, pose, scan_of


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


def test_where_a_base_knows_no_floor_a_viewpoint_on_it_knows_none() -> None:
    ahead = np.abs(azimuths()) < 0.5
    found = seen_from(np.where(ahead, np.float32(2), np.float32(0)), pose(0.1, 0.0, np.pi / 2))
    left = np.abs(azimuths() - np.pi / 2) < 0.3
    assert (found[left] > 1.8).all() and not found[np.abs(azimuths() - np.pi / 2) > 0.7].any()
