"""Rows of the histogram of latencies."""

from __future__ import annotations

import pytest

from tests.benchmark.latency import BORDERS_MS, COLUMNS, row


def test_a_row_has_the_shares_of_all_poses_below_each_time() -> None:
    found = row("10 Hz", [10.0, 20.0, 40.0, 300.0])
    assert len(found) == len(COLUMNS) and found[:2] == ["10 Hz", 4]
    shares = dict(zip(BORDERS_MS, found[2:], strict=False))
    assert (shares[15], shares[30], shares[45], shares[250]) == (25.0, 50.0, 75.0, 75.0)
    assert found[-2:] == pytest.approx([30.0, 292.2])
