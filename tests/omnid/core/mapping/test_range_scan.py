"""Gaps of range scans."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.mapping.range_scan import SECTORS, fill_gaps


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
