"""Merging of maps: which keyframes are searched among all, and maps whose recognitions disagree."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from calib.panorama import Cylinder
from omnid.core.places.merge import ENOUGH_CONSISTENT, merge
from omnid.core.places.place_features import PlaceFeatures
from omnid.core.places.place_map import Link, PlaceKeyframe, PlaceMap
from omnid.core.places.place_search import Expected, PlaceSearch
from omnid.core.places.recognition import Recognition
from omnid.core.types.stereo_model import StereoModel

MODEL = StereoModel(Cylinder(1200, 400, 150.0), 0.2)
T_MAP_OTHER = se3.exp([3.0, -2.0, 0, 0, 0, 1.0])
COVARIANCE = 1e-4 * np.eye(6)
COUNT = 100


def drive(T_map_start: np.ndarray) -> PlaceMap:
    """A map of a drive along a line; keyframe n has the value n in its thumbnail."""
    places, step = PlaceMap(), se3.exp([0.3, 0, 0, 0, 0, 0])
    features = PlaceFeatures(np.zeros((1, 128), np.uint8), np.zeros((1, 3), np.float32))
    for n in range(COUNT):
        T = T_map_start @ se3.exp([0.3 * n, 0, 0, 0, 0, 0])
        scan, free_m = np.full(360, np.nan, np.float16), np.zeros(360, np.float16)
        evidence = np.full((16, 128), n, np.int8), scan, free_m, features
        keyframe = PlaceKeyframe(n, 0, n, T, (n + 1) * COVARIANCE, *evidence)
        places.add(keyframe, T, Link(n - 1, n, step, COVARIANCE) if n else None)
    return places


class Searches:
    """In place of the search: keyframe n is recognised at keyframe n, in the part `wrong` half a drive from it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, wrong: range) -> None:
        self.among_all, self.nearby = list[int](), list[int]()

        def far(_: PlaceSearch, small: np.ndarray, *rest: object) -> Recognition:
            n = int(small[0, 0])
            self.among_all.append(n)
            return Recognition((n + COUNT // 2 * (n in wrong)) % COUNT, np.eye(4), COVARIANCE, 60, 80, 8)

        def near(
            _: PlaceSearch, small: np.ndarray, features: object, places: PlaceMap, expected: Expected
        ) -> Recognition:
            n = int(small[0, 0])
            self.nearby.append(n)
            np.testing.assert_allclose(expected.T_map_rect, places.poses[n], atol=1e-9)
            return Recognition(n, np.eye(4), COVARIANCE, 60, 80, 8)

        monkeypatch.setattr(PlaceSearch, "far", far)
        monkeypatch.setattr(PlaceSearch, "near", near)


def test_a_few_keyframes_all_over_the_map_are_searched_among_all_and_the_others_nearby(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searches, places = Searches(monkeypatch, range(0)), drive(np.eye(4))
    assert merge(places, drive(T_MAP_OTHER), MODEL) == COUNT
    assert len(searches.among_all) == ENOUGH_CONSISTENT and len(searches.nearby) == COUNT - ENOUGH_CONSISTENT
    assert np.diff(sorted(searches.among_all)).max() < 2.5 * COUNT / ENOUGH_CONSISTENT
    for n in range(COUNT):
        np.testing.assert_allclose(places.poses[COUNT + n], places.poses[n], atol=1e-6)


def test_maps_are_not_merged_where_a_half_of_one_is_recognised_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    searches, places = Searches(monkeypatch, range(COUNT // 2, COUNT)), drive(np.eye(4))
    assert merge(places, drive(T_MAP_OTHER), MODEL) == 0 and len(places) == COUNT
    assert len(searches.among_all) == COUNT and not searches.nearby


def test_a_part_that_is_recognised_elsewhere_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    searches, places = Searches(monkeypatch, range(10)), drive(np.eye(4))
    assert merge(places, drive(T_MAP_OTHER), MODEL) > 0.9 * COUNT
    np.testing.assert_allclose(places.poses[COUNT + 50], places.poses[50], atol=1e-6)
    assert len(searches.among_all) < 2 * ENOUGH_CONSISTENT
