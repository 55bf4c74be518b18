"""Keyframes of what has changed leave the map after several visits, those that were useful later."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.places.map_parts import AGED_MISSES, VISIT_M, Ageing
from omnid.core.places.place_map import KeyframeUse, PlaceMap
from tests.omnid.core.places.test_place_map import chain, pose

HERE = pose(2)[:3, 3]


@pytest.fixture
def places() -> PlaceMap:
    return chain(5)


def visit(ageing: Ageing, number: int, inliers: dict[int, int], *more: dict[int, int]) -> None:
    """Let the frames of a visit pass keyframe 2."""
    for frame, found in enumerate((inliers, *more)):
        ageing.observe(HERE, found, 2 * VISIT_M * number + 0.1 * frame)


def test_what_is_missed_visit_after_visit_leaves_and_its_links_stay(places: PlaceMap) -> None:
    ageing = Ageing(places)
    for number in range(AGED_MISSES):
        visit(ageing, number, {2: 5, 0: 80}, {2: 0, 0: 70})
    assert places.uses == {2: KeyframeUse(0, AGED_MISSES), 0: KeyframeUse(AGED_MISSES, 0)} and len(places) == 5
    visit(ageing, AGED_MISSES, {2: 5, 0: 80})
    assert list(places.keyframes) == [0, 1, 3, 4] and ageing.aged == 1 and 2 not in places.uses
    assert (1, 3) in {(link.a, link.b) for link in places.links}


def test_a_visit_at_which_it_is_found_begins_the_count_again(places: PlaceMap) -> None:
    ageing = Ageing(places)
    for number in range(3 * AGED_MISSES):
        visit(ageing, number, {2: 5}, {2: 60} if number % AGED_MISSES == 0 else {2: 3})
    assert len(places) == 5 and places.uses[2].found == 3 and places.uses[2].missed == AGED_MISSES - 1


def test_what_was_found_often_is_kept_as_long(places: PlaceMap) -> None:
    ageing = Ageing(places)
    places.uses[2] = KeyframeUse(10, 0)
    for number in range(10):
        visit(ageing, number, {2: 0})
    assert 2 in places.keyframes and places.uses[2] == KeyframeUse(10, 10)
    visit(ageing, 10, {2: 0})
    assert 2 not in places.keyframes


def test_keyframes_that_are_farther_away_are_not_missed(places: PlaceMap) -> None:
    ageing = Ageing(places)
    for number in range(10):
        visit(ageing, number, {1: 0, 4: 0, 7: 0})
    assert places.uses == {} and len(places) == 5
    assert np.linalg.norm(places.poses[1][:3, 3] - HERE) < 1.5
