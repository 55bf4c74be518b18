"""Among places that look the same none is chosen, unless odometry tells which one it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.features import describe
from omnid.core.places.place_map import PlaceKeyframe, PlaceMap
from omnid.core.places.place_search import Expected, PlaceSearch
from omnid.core.places.signature import thumbnail
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation.closed_worlds import twin_corridor
from tests.simulation.paths import planar_poses

PERIOD_M = 6.0
X = np.array([0.6, 0.9, 1.2])  # of the keyframes in one half of the corridor
QUERY = planar_poses(np.array([[1.0, 0.05]]), np.array([2.0]))[0]


@pytest.fixture(scope="module")
def twins(cameras: RenderedCameras) -> RenderedCameras:
    return replace(cameras, scene=twin_corridor(2, PERIOD_M))


@pytest.fixture(scope="module")
def query(twins: RenderedCameras) -> StereoFrame:
    return twins.frame(50, QUERY)


@pytest.fixture(scope="module")
def places(twins: RenderedCameras) -> PlaceMap:
    """Keyframes in both halves; the poses are those of the world."""
    places = PlaceMap()
    x = np.concatenate([X, X + PERIOD_M])
    for number, T in enumerate(planar_poses(np.column_stack([x, 0 * x]), 0 * x)):
        frame = twins.frame(number, T)
        places.add(
            PlaceKeyframe(
                number,
                0,
                number,
                T,
                np.eye(6),
                thumbnail(frame.lower),
                np.full(360, np.nan, np.float16),
                np.zeros(360, np.float16),
                describe(frame),
            ),
            T,
        )
    return places


def test_of_two_equal_places_none_is_recognised_and_it_is_counted(
    twins: RenderedCameras, places: PlaceMap, query: StereoFrame
) -> None:
    search, small = PlaceSearch(twins.model), thumbnail(query.lower)
    assert search.far(small, describe(query), places, list(places.keyframes)) is None and search.ambiguous == 1
    alone = search.far(small, describe(query), places, [0, 1, 2])
    assert alone is not None and search.ambiguous == 1
    assert motion_errors(places.poses[alone.id] @ alone.T_place_rect, QUERY)[0] < 0.02


@pytest.mark.parametrize("half", [0, 1])
def test_odometry_tells_which_of_two_equal_places_it_is(
    twins: RenderedCameras, places: PlaceMap, query: StereoFrame, half: int
) -> None:
    """None is taken if odometry excludes all places that look like this one."""
    search, small = PlaceSearch(twins.model), thumbnail(query.lower)
    there = se3.exp([half * PERIOD_M, 0, 0, 0, 0, 0]) @ QUERY
    expected = Expected(there, dict.fromkeys(places.keyframes, 0.3), dict.fromkeys(places.keyframes, 0.1), False)
    found = search.near(small, describe(query), places, expected)
    assert found is not None and found.id // len(X) == half
    assert motion_errors(places.poses[found.id] @ found.T_place_rect, there)[0] < 0.02
    beside = se3.exp([half * PERIOD_M, 0.6, 0, 0, 0, 0]) @ QUERY
    excluded = replace(expected, T_map_rect=beside)
    assert search.near(small, describe(query), places, excluded) is None and search.refused == 1
