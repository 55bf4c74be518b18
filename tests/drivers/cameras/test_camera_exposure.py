"""Ranges of exposure time and gain: the nearest value that a camera accepts, and that of two cameras."""

from __future__ import annotations

import pytest

from drivers.cameras.camera_exposure import ValueRange


@pytest.mark.parametrize(("value", "nearest"), [(-9, 3), (3.9, 3), (6, 8), (12, 13), (20, 18), (1e9, 18)])
def test_the_nearest_value_is_a_step_of_the_range(value: float, nearest: int) -> None:
    """The largest value of a range need not be one of its steps."""
    assert ValueRange(3, 19, 5).nearest(value) == nearest


def test_both_cameras_accept_a_common_range() -> None:
    assert ValueRange(3, 200, 1).common(ValueRange(10, 100, 5)) == ValueRange(10, 100, 5)
    assert ValueRange(0, 50, 2).nearest(49.9) == 50 and ValueRange(7, 7, 0).nearest(3) == 7
