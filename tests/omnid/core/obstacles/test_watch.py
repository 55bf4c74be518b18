"""Cells that are not watched, and from where something may have come to them."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.obstacles.watch import FLOOD_MPS, FRESH_NS, ONCE_FREE_NS, Watch

CELLS, CELL_M = 40, 0.05
PASSED_NS = 100_000_000
BEFORE, BEYOND = (slice(None), slice(0, 20)), (slice(None), slice(20, 40))  # a place, and what is next to it


def reached(*, was_free: bool, later_ns: int = 0) -> np.ndarray:
    """Return the cells (CELLS, CELLS) of a place to which something may have come from floor beside it that was lost.

    was_free: that floor was free by all layers; later_ns: time since then. Nothing is watched, and nothing in view.
    """
    watch = Watch(CELLS, CELL_M)
    floor = np.ones((CELLS, CELLS), bool)
    watch.spread(0, PASSED_NS, floor, np.zeros_like(floor))
    watch.free_ns[BEFORE] = 0
    if was_free:
        watch.free_ns[BEYOND] = 0
    floor[BEYOND] = False
    return watch.spread(later_ns + PASSED_NS, PASSED_NS, floor, np.zeros_like(floor))


def test_something_comes_from_floor_that_was_free_and_is_lost_as_fast_as_a_person() -> None:
    found = reached(was_free=True)
    assert found[BEFORE].any() and not found[BEYOND].any()
    steps = FLOOD_MPS * PASSED_NS * 1e-9 / CELL_M
    assert np.flatnonzero(found[CELLS // 2]).min() == pytest.approx(20 - steps, abs=1.0)


def test_nothing_comes_from_floor_that_only_noise_has_shown() -> None:
    assert not reached(was_free=False).any()


def test_nothing_comes_from_floor_that_was_free_long_ago() -> None:
    assert not reached(was_free=True, later_ns=ONCE_FREE_NS).any()


def test_evidence_is_forgotten_in_half_a_second() -> None:
    watch, window = Watch(CELLS, CELL_M), (slice(0, 2), slice(0, 2))
    for _ in range(20):
        watch.take(PASSED_NS, window, np.full((2, 2), 1.0, np.float32))
    assert watch.watched[0, 0] and not watch.watched[3, 3]
    watch.take(FRESH_NS, window, np.zeros((2, 2), np.float32))
    assert not watch.watched.any()
