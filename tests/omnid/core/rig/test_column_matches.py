"""Points are found in both panoramas of a pair, also where the rig is wrong by degrees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from omnid.core.rig.column_matches import POINTS, is_motion_unknown, match, together
from omnid.core.types.pixel_times import PixelTimes
from tests.omnid.core.rig.shown_pairs import ShownPair
from tests.omnid.core.scenery import RenderedCameras

Room = tuple[RenderedCameras, NDArray[np.float64]]


@pytest.mark.parametrize("turn_px", [0.0, 5.5, -9.0])
def test_points_are_found_beside_their_column(room: Room, turn_px: float) -> None:
    pair = ShownPair.of(room[0].frame(0, room[1][0]), upper_turn_px=turn_px)
    found = match(pair.lower, pair.upper, pair.visible)
    assert 0.9 * POINTS < found.tried <= POINTS and found.clear > 0.4 * POINTS and len(found.lower) > 0.4 * POINTS
    apart_px = pair.lower.apart(found.upper[:, 0] - found.lower[:, 0])
    assert np.median(apart_px) == pytest.approx(turn_px, abs=0.1) and np.median(np.abs(apart_px - turn_px)) < 0.2
    assert (found.upper[:, 1] > found.lower[:, 1]).all(), "a point lies lower in the upper panorama"


def test_darkness_has_no_points(room: Room) -> None:
    dark = ShownPair.of(room[0].frame(0, room[1][0])).dark
    found = match(dark.lower, dark.upper, dark.visible)
    assert len(found.lower) == len(found.upper) == found.clear == 0


def test_matches_of_pairs_are_joined(room: Room) -> None:
    pair = ShownPair.of(room[0].frame(0, room[1][0]))
    one = match(pair.lower, pair.upper, pair.visible)
    both = together([one, one])
    assert np.array_equal(both.lower, np.vstack([one.lower, one.lower])) and len(both.upper) == 2 * len(one.upper)
    assert (both.tried, both.clear) == (2 * one.tried, 2 * one.clear)
    assert together([]).lower.shape == (0, 2)


def test_the_motion_matters_only_between_several_exposures(room: Room) -> None:
    pair = ShownPair.of(room[0].frame(0, room[1][0]))
    later = ShownPair(0, pair.lower, pair.upper, pair.visible, PixelTimes(skew_s=0.01))
    assert not is_motion_unknown(pair, None) and is_motion_unknown(later, None)


def test_exchanged_cameras_match_less_than_half_as_often(room: Room) -> None:
    pair = ShownPair.of(room[0].frame(0, room[1][0]))
    straight, exchanged = (match(one.lower, one.upper, one.visible) for one in (pair, pair.exchanged))
    assert len(exchanged.lower) < 0.41 * len(straight.lower)
