"""Maps whose features stay in the file until they are needed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.panorama import Cylinder
from omnid.core.places.place_map import PlaceMap
from omnid.core.places.place_rig import seen_by
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from tests.omnid.formats.place_maps import RIG, some_places
from tests.omnid.formats.test_place_file import changed, same


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_places(tmp_path / "a.omap", some_places(12), RIG)
    return tmp_path / "a.omap"


def stored(path: Path) -> PlaceMap:
    return read_places(path, most_feature_bytes=100_000)[0]


def test_features_are_those_that_were_written_and_few_are_in_memory(path: Path) -> None:
    places, written = stored(path), some_places(12)
    assert places.stored is not None and places.stored.store.reads == 0
    for id in (*range(12), 3):
        assert places.keyframes[id].features.count == 256
        assert same(places.keyframes[id].features.loaded(), written.keyframes[id].features)
    assert 0 < places.stored.store.nbytes <= 100_000 and places.stored.store.reads == 13
    assert read_places(path, most_feature_bytes=12 * 256 * 140)[0].stored is None


def test_a_map_that_was_not_read_whole_is_written_whole(path: Path, tmp_path: Path) -> None:
    """Over its own file as well, of which it reads the old content on."""
    before, places = path.read_bytes(), stored(path)
    write_places(tmp_path / "b.omap", places, RIG)
    assert (tmp_path / "b.omap").read_bytes() == before
    write_places(path, places.part(range(6)), RIG)
    assert len(read_places(path)[0]) == 6
    assert same(places.keyframes[11].features.loaded(), some_places(12).keyframes[11].features)


def test_damaged_features_recognise_nothing_and_are_not_written(path: Path, tmp_path: Path) -> None:
    changed(path, "UPDATE features SET descriptors = zeroblob(32768) WHERE id = 4", "DELETE FROM features WHERE id = 5")
    places = stored(path)
    assert places.stored is not None
    assert [places.keyframes[id].features.loaded().count for id in (3, 4, 5)] == [256, 0, 0]
    assert places.stored.store.unreadable == 2
    with pytest.raises(OmnidError, match="the features of keyframe 4 in the map that was read are damaged"):
        write_places(tmp_path / "b.omap", places, RIG)
    with pytest.raises(OmnidError, match="the checksum of row 5 of features"):
        read_places(path)


@pytest.mark.parametrize("column", ["codes", "azimuths", "features"])
def test_codes_that_were_changed_are_refused(path: Path, column: str) -> None:
    with pytest.raises(OmnidError, match="the checksum of row 3 of keyframe"):
        stored(changed(path, f"UPDATE keyframe SET {column} = 1 WHERE id = 2"))


def test_the_horizon_of_another_panorama_shifts_what_is_read(path: Path) -> None:
    places, shifted = stored(path), replace(RIG, cylinder=Cylinder(1304, 380, 130.75))
    seen_by(places, RIG, shifted)
    moved = places.keyframes[2].features.loaded().views - some_places(12).keyframes[2].features.loaded().views
    np.testing.assert_allclose(moved, [[0, 2, 2]] * 256, atol=1e-4)
