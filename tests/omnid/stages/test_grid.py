"""The stage that draws the map: now and then and at the end, only what has changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omnid.core.mapping.scan_grid import KeyframeScans
from omnid.messages import PlaceUpdate
from omnid.stages.mapping import MapGrid
from omnid.tracking_state import MapState

SECOND_NS = 10**9
SCAN = np.full(360, 2.0, np.float16)


def scans(count: int) -> KeyframeScans:
    return KeyframeScans(
        dict.fromkeys(range(count), SCAN), dict.fromkeys(range(count), SCAN), np.tile(np.eye(4), (count, 1, 1))
    )


def grid_update(seq: int, seen: KeyframeScans | None) -> PlaceUpdate:
    return PlaceUpdate(seq, seq * SECOND_NS, np.eye(4), np.eye(4), np.eye(6), MapState.ODOMETRY_ONLY, scans=seen)


def given(stage: MapGrid, updates: list[PlaceUpdate]) -> list[int]:
    return [found.seq for found in map(stage.process, updates) if found is not None]


def test_it_is_drawn_when_it_is_due_and_has_changed() -> None:
    stage, one, two = MapGrid(0.05, np.eye(4), every_s=2.0), scans(1), scans(2)
    assert given(stage, [grid_update(k, one if k < 7 else two) for k in range(1, 8)]) == [2, 7]
    assert stage.finish() == []
    assert stage.process(grid_update(8, scans(3))) is None
    [last] = stage.finish()
    assert last.seq == 8 and last.grid.cells.max() == 100


def test_without_a_period_it_is_drawn_at_the_end() -> None:
    stage = MapGrid(0.05, np.eye(4))
    assert stage.finish() == [] and given(stage, [grid_update(k, scans(1)) for k in range(5)]) == []
    assert [found.seq for found in stage.finish()] == [4]
    empty = MapGrid(0.05, np.eye(4))
    empty.process(grid_update(1, None))
    assert empty.finish() == []


def test_scans_of_unknown_place_are_not_drawn_into_the_map() -> None:
    """Of a saved map, or after a gap, until a place is recognised; the last grid stays."""
    stage = MapGrid(0.05, np.eye(4), every_s=1.0)
    known, elsewhere = grid_update(2, scans(1)), replace(grid_update(4, scans(2)), is_known=False)
    assert given(stage, [known, elsewhere]) == [2] and stage.finish() == []
    assert given(stage, [grid_update(6, scans(3))]) == [6]
