"""Scatter of the columns of the first pairs: what is looked at more closely, and what is told as a rig that is off."""

from __future__ import annotations

import pytest

from omnid.core.rig.rig_check import RigFinding
from omnid.core.rig.start_check import StartFinding, start_finding
from omnid.refinement.foreign_rig import is_suspicious


def finding(spread_px: float) -> RigFinding:
    return RigFinding("unknown", 200, 320, 0.0, spread_px, (), 0.1, None)


@pytest.mark.parametrize(("spread_px", "condition", "suspicious"),
                         [(0.1, "undecided", False), (0.45, "undecided", True), (0.7, "drifted", True)])
def test_scattered_columns(spread_px: float, condition: str, suspicious: bool) -> None:
    found = start_finding(finding(spread_px), 20)
    assert (found.condition, is_suspicious(found)) == (condition, suspicious)


def test_a_rig_that_is_off_is_suspicious_and_one_that_was_not_seen_is_not() -> None:
    assert is_suspicious(StartFinding("drifted", finding(0.1), 20)) and not is_suspicious(None)
