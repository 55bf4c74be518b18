"""Among places that look the same none is chosen, unless odometry tells which one it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.places.code_index import CodeIndex, azimuths_of, codes_of
from omnid.core.places.features import describe
from omnid.core.places.place_features import FeatureStore, PlaceFeatures, StoredFeatures
from omnid.core.places.place_map import PlaceKeyframe, PlaceMap, StoredPlaces
from omnid.core.places.place_search import VOTED_OF_FILE, Expected, PlaceSearch
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
    # Both are proposed, to what may settle it: here a pose that is known by other evidence.
    there = se3.exp([PERIOD_M, 0, 0, 0, 0, 0]) @ QUERY
    assert {round(T[0, 3] - QUERY[0, 3]) for T in search.proposed(places.poses)} == {0, round(PERIOD_M)}
    near = there @ se3.exp([0.2, -0.1, 0, 0, 0, 0.05])
    settled = search.far(small, describe(query), places, list(places.keyframes), near)
    assert settled is not None and motion_errors(places.poses[settled.id] @ settled.T_place_rect, there)[0] < 0.02
    assert search.ambiguous == 1
    alone = search.far(small, describe(query), places, [0, 1, 2])
    assert alone is not None and search.ambiguous == 1
    assert motion_errors(places.poses[alone.id] @ alone.T_place_rect, QUERY)[0] < 0.02


def in_a_file(places: PlaceMap, ids: list[int], width: int) -> PlaceMap:
    """The map of some keyframes and of 1,100 others elsewhere, of which codes only are in memory."""
    rng, large = np.random.default_rng(6), places.part(ids)
    of_file = {id: places.keyframes[id].features.loaded() for id in ids}
    for id in range(100, 1200):
        views = rng.uniform(0, 100, (60, 3)).astype(np.float32) * np.float32([width / 100, 1, 1])
        views[:, 2] += 101
        of_file[id] = PlaceFeatures(rng.integers(0, 256, (60, 128), dtype=np.uint8), views)
        large.keyframes[id] = replace(places.keyframes[ids[0]], id=id)
        large.poses[id] = se3.exp([0.3 * id, 90, 0, 0, 0, 0])
    store = FeatureStore(of_file.get, 10**6)
    for id, features in of_file.items():
        large.keyframes[id] = replace(large.keyframes[id], features=StoredFeatures(id, features.count, store))
    codes, azimuths = (
        [codes_of(one) for one in of_file.values()],
        [azimuths_of(one, width) for one in of_file.values()],
    )
    index = CodeIndex(
        np.array(list(of_file)),
        np.array([len(one) for one in codes]),
        np.concatenate(codes),
        np.concatenate(azimuths),
    )
    large.stored = StoredPlaces(index, store)
    return large


def test_in_a_large_map_few_keyframes_are_read_and_twins_stay_ambiguous(
    twins: RenderedCameras, places: PlaceMap, query: StereoFrame
) -> None:
    """Thumbnails are all the same in it, so they tell nothing."""
    search, small, width = PlaceSearch(twins.model), thumbnail(query.lower), twins.cylinder.width
    one = in_a_file(places, [0, 1, 2], width)
    found = search.far(small, describe(query), one, list(one.keyframes))
    assert found is not None and one.stored is not None and one.stored.store.reads == VOTED_OF_FILE
    assert motion_errors(one.poses[found.id] @ found.T_place_rect, QUERY)[0] < 0.02
    both = in_a_file(places, list(places.keyframes), width)
    assert search.far(small, describe(query), both, list(both.keyframes)) is None and search.ambiguous == 1
    # A keyframe of the run itself, whose features are in memory, is found beside those of the file.
    both.keyframes[5000], both.poses[5000] = replace(places.keyframes[1], id=5000), places.poses[1]
    others = [id for id in both.keyframes if id > 5]
    newest = search.far(small, describe(query), both, others)
    assert newest is not None and newest.id == 5000


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
