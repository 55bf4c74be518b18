"""Ends of the floor that a ring shows."""

from __future__ import annotations

import math

import pytest

from omnid.core.control.collision_monitor import UNKNOWN_SECTORS, unknown_ends

COUNT = 36


@pytest.mark.parametrize(
    ("range_m", "free_m", "is_end", "is_gap"),
    [
        (math.inf, 6.0, False, False),
        (math.inf, 1.5, True, False),
        (math.inf, 0.0, False, False),  # the ring holds no free floor
        (math.nan, 0.7, True, False),
        (2.0, 1.95, False, False),
        (2.0, 1.0, True, True),
    ],
)
def test_nothing_is_known_between_seen_floor_and_a_surface(
    range_m: float, free_m: float, is_end: bool, is_gap: bool
) -> None:
    ranges, free = [math.inf] * COUNT, [6.0] * COUNT
    for k in range(10, 10 + UNKNOWN_SECTORS):
        ranges[k], free[k] = range_m, free_m
    found = unknown_ends(ranges, free, 0.15)
    assert [end.sector for end in found] == (list(range(10, 10 + UNKNOWN_SECTORS)) if is_end else [])
    assert all(end.free_m == free_m and end.is_gap == is_gap for end in found)
    ranges[10], free[10] = math.inf, 6.0
    assert not unknown_ends(ranges, free, 0.15), "too narrow to be more than noise"


def test_a_ring_without_free_floor_is_unknown_where_it_shows_no_range() -> None:
    ranges = [2.0] * COUNT
    ranges[: UNKNOWN_SECTORS + 1] = [math.nan] * (UNKNOWN_SECTORS + 1)
    assert [end.free_m for end in unknown_ends(ranges, (), 0.15)] == [0.0] * (UNKNOWN_SECTORS + 1)
