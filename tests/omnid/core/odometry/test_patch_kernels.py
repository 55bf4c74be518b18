"""Compiled part of the fit of patches."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.odometry import patch_kernels


@pytest.mark.parametrize("count", [1, 2, 3, 8, 57])
def test_median(count: int) -> None:
    """As numpy's, of the first values alone."""
    values = np.random.default_rng(count).integers(0, 20, 60) / 8
    expected = np.median(values[:count])
    assert patch_kernels.median_of(values, count) == expected
