"""Floor that was free and is suddenly hidden, along directions."""

from __future__ import annotations

from typing import Final

import numpy as np
import pytest

from omnid.core.obstacles.usual_floor import HIDDEN_SUM, Hidden, UsualFloor

CELLS: Final = 80
CELL_M: Final = 0.05
EYE: Final = np.array([10.5, 40.5])  # cells; the only direction leads ahead, along x
USUAL: Final = 2.0  # evidence of the floor, without which the log-odds are 1
IN_VIEW_M, NEAREST_M, FAR_M, END_M = 0.9, 1.0, 1.6, 3.0


def found(odds_by_range: dict[tuple[float, float], float], stands_m: float | None = None) -> Hidden:
    """Return what is hidden ahead, by the log-odds of cells from one range to another, and where something stands."""
    range_m = CELL_M * (np.arange(CELLS) + 0.5 - EYE[0])
    odds, was_floor = np.zeros((CELLS, CELLS), np.float32), np.zeros((CELLS, CELLS), bool)
    was_floor[:, (range_m > IN_VIEW_M) & (range_m < END_M)] = True
    for (first, end), value in odds_by_range.items():
        odds[:, (range_m > first) & (range_m < end)] = value
    origin = np.array([*EYE, CELL_M, 3.5, 28.0])
    usual = UsualFloor(CELLS)
    usual.mean[:] = USUAL
    stands = np.zeros_like(was_floor)
    if stands_m is not None:
        stands[:, np.abs(range_m - stands_m) < CELL_M] = True
    return usual.hidden(odds, was_floor, stands, origin, np.zeros(1), NEAREST_M)


def test_what_hides_all_floor_in_view_stands_nearer() -> None:
    hidden = found({(IN_VIEW_M, END_M): 1.0})
    assert hidden.near[0] >= 2.0 and hidden.ranges_m[0] == pytest.approx(IN_VIEW_M, abs=CELL_M)
    assert hidden.behind[40].sum() == pytest.approx((END_M - IN_VIEW_M) / CELL_M, abs=2)


def test_what_hides_floor_farther_away_does_not_stand_nearer() -> None:
    hidden = found({(IN_VIEW_M, FAR_M): -1.0, (FAR_M, END_M): 1.0})
    assert hidden.near[0] < -5.0 and hidden.ranges_m[0] == pytest.approx(FAR_M, abs=2 * CELL_M)


def test_floor_in_view_shows_that_nothing_stands_nearer() -> None:
    """All of the floor of a direction counts: two patches of noise in front of it are outweighed."""
    hidden = found({(IN_VIEW_M, NEAREST_M): 1.0, (NEAREST_M, END_M): -1.0})
    assert hidden.near[0] < -5.0 and np.isnan(hidden.ranges_m[0]) and not hidden.behind.any()


def test_little_evidence_shows_nothing() -> None:
    assert HIDDEN_SUM < 28.0 * (1 / IN_VIEW_M - 1 / END_M) * 0.4
    for odds in (0.1, 0.4):  # less than any noise, and less than half of what floor that is hidden has
        hidden = found({(IN_VIEW_M, END_M): odds})
        assert hidden.near[0] == 0.0 and np.isnan(hidden.ranges_m[0])


def test_what_stands_explains_by_itself_that_it_hides_floor() -> None:
    hidden = found({(IN_VIEW_M, END_M): 1.0}, stands_m=0.7)
    assert hidden.near[0] == 0.0 and not hidden.behind.any()
