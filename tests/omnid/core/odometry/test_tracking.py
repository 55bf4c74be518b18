"""Tracking on panoramas that wrap around."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.odometry.tracking import KltSettings, flow, track
from tests.omnid.core.scenery import texture, turned, wrapped

Array = NDArray[np.float64]

KLT = KltSettings()


def grid(width: int = 480, height: int = 120) -> Array:
    """Points (N, 2) all around, the seam included."""
    columns, rows = np.meshgrid(np.arange(0, width, 12.0), np.arange(24, height - 20, 16.0))
    return np.column_stack([columns.ravel(), rows.ravel()])


def column_error(found: Array, expected: Array, width: int = 480) -> Array:
    return np.asarray((found[:, 0] - expected[:, 0] + width / 2) % width - width / 2)


@pytest.mark.parametrize("columns", [0.0, 0.4, -3.3, 7.25])
def test_tracks_a_shift_to_a_twentieth_of_a_pixel_also_across_the_seam(columns: float) -> None:
    before, points = texture(1), grid()
    there, found = track(wrapped(before), wrapped(turned(before, columns)), points, points, KLT)
    assert found.mean() > 0.99
    error = column_error(there[found], points[found] + (columns, 0))
    assert np.median(np.abs(error)) < 0.02 and np.abs(error).max() < 0.05
    assert np.abs(there[found, 1] - points[found, 1]).max() < 0.05
    assert (there[:, 0] >= 0).all() and (there[:, 0] < 480).all()


def test_a_guess_extends_the_range() -> None:
    before, points = texture(2), grid()
    after = turned(before, 171)
    there, found = track(wrapped(before), wrapped(after), points, points + np.array([170.0, 0]), KLT)
    assert found.mean() > 0.98
    assert np.abs(column_error(there[found], points[found] + (171, 0))).max() < 0.05
    _, found = track(wrapped(before), wrapped(after), points, points, KLT)
    assert found.mean() < 0.2


def test_the_forward_backward_check_refuses_points_that_have_disappeared() -> None:
    before, points = texture(4), grid()
    after = before.copy()
    after[:, 200:280] = texture(5)[:, 200:280]
    inside = (points[:, 0] > 212) & (points[:, 0] < 268)
    _, reported = flow(wrapped(before), wrapped(after), points, points, KLT)
    _, found = track(wrapped(before), wrapped(after), points, points, KLT)
    assert reported[inside].mean() > 0.8
    assert found[inside].mean() < 0.2
    assert found[(points[:, 0] < 180) | (points[:, 0] > 300)].mean() > 0.98
