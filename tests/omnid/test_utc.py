"""Stamps as text."""

from __future__ import annotations

import pytest

from omnid.utc import utc


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (1_700_000_000_123_456_789, "2023-11-14T22:13:20.123Z"),
        (12_345_000_000, "12.345 s"),  # the clock of a simulation
        (10 * 2**60, "11529215046.068 s"),  # beyond what a date can be
    ],
)
def test_a_stamp_that_is_no_unix_time_is_seconds(stamp_ns: int, text: str) -> None:
    assert utc(stamp_ns) == text
