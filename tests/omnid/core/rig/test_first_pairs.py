"""The first pairs decide in rounds: a right rig in one, a contradiction in two that agree, darkness in none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.rig.column_finding import RigState
from omnid.core.rig.first_pairs import MOST_ROUND_PAIRS, RETRY_S, ROUND_PAIRS, FirstPairs
from tests.omnid.core.rig.shown_pairs import ShownPair
from tests.omnid.core.scenery import RenderedCameras

Room = tuple[RenderedCameras, NDArray[np.float64]]

SECOND_NS = 10**9


@pytest.fixture(scope="module")
def pair(room: Room) -> ShownPair:
    return ShownPair.of(room[0].frame(0, room[1][0]))


def pairs_until_decided(first: FirstPairs, pair: ShownPair) -> int:
    """Show a pair, two seconds apart, until the check has ended; return how often."""
    for count in range(100):
        if first.ended:
            return count
        first.add(ShownPair(2 * count * SECOND_NS, pair.lower, pair.upper, pair.visible, pair.times))
    raise AssertionError("no decision")


def test_a_right_rig_needs_one_round(room: Room, pair: ShownPair) -> None:
    first = FirstPairs(room[0].cylinder)
    assert pairs_until_decided(first, pair) == ROUND_PAIRS and first.state is RigState.FITS


@pytest.mark.parametrize("kind", ["exchanged", "turned"])
def test_a_contradiction_needs_two_rounds(room: Room, pair: ShownPair, kind: str) -> None:
    columns = round(3 / 360 * room[0].cylinder.width)
    wrong = pair.exchanged if kind == "exchanged" else ShownPair.of(room[0].frame(0, room[1][0]), 0, columns)
    first = FirstPairs(room[0].cylinder)
    assert pairs_until_decided(first, wrong) == 2 * ROUND_PAIRS
    assert first.state is (RigState.EXCHANGED if kind == "exchanged" else RigState.BROKEN)


def test_darkness_decides_nothing_and_the_next_round_begins_later(room: Room, pair: ShownPair) -> None:
    first = FirstPairs(room[0].cylinder)
    for stamp_ns in range(MOST_ROUND_PAIRS):
        first.add(ShownPair(stamp_ns, pair.dark.lower, pair.dark.upper, pair.visible))
    assert first.finding is not None and first.finding.state is first.state is RigState.UNCHECKED and not first.ended
    for stamp_ns in range(100, 100 + 2 * ROUND_PAIRS):
        first.add(ShownPair(stamp_ns, pair.lower, pair.upper, pair.visible))
    assert first.state is RigState.UNCHECKED, "too early"
    for number in range(ROUND_PAIRS):
        first.add(ShownPair(round(2 * RETRY_S * SECOND_NS) + number, pair.lower, pair.upper, pair.visible))
    assert first.state is RigState.FITS
