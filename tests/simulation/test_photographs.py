"""Photographs as textures: they cover walls, floor and pictures, are sharp, and are those of the seed."""

from __future__ import annotations

from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from tests.simulation import Scene, build
from tests.simulation.photographs import POSTERS, SURFACES, photographed, with_photographs

pytestmark = pytest.mark.skipif(find_spec("skimage") is None, reason="needs the files of scikit-image")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build("rooms", 3, 160, 4).scene


def test_every_photograph_is_there_in_grey() -> None:
    for name in (*SURFACES, *POSTERS):
        assert photographed(name).ndim == 2 and photographed(name).std() > 10


def test_all_but_the_ceiling_shows_photographs_of_the_seed(scene: Scene) -> None:
    first, again, other = (with_photographs(scene, seed) for seed in (3, 3, 4))
    for before, now, same, third in zip(
        scene.rectangles, first.rectangles, again.rectangles, other.rectangles, strict=True
    ):
        assert np.array_equal(now.texture, same.texture)
        if before.name == "ceiling":
            assert now.texture is before.texture
        else:
            assert not np.array_equal(now.texture, before.texture)
            assert not np.array_equal(now.texture, third.texture)
        assert np.array_equal(now.corners, before.corners)


def test_a_surface_repeats_in_mirror_images_without_seams(scene: Scene) -> None:
    floor = with_photographs(scene, 3).named("floor").texture.astype(float)
    columns, rows = np.abs(np.diff(floor, axis=1)).mean(axis=0), np.abs(np.diff(floor, axis=0)).mean(axis=1)
    assert columns.max() < 2 * np.median(columns) and rows.max() < 2 * np.median(rows)


def test_posters_keep_their_form_and_are_parts_of_photographs(scene: Scene) -> None:
    faces = zip(scene.rectangles, with_photographs(scene, 3).rectangles, strict=True)
    posters = [(before, now) for before, now in faces if before.name.startswith("poster")]
    assert all(now.texture.shape == before.texture.shape for before, now in posters)
    shown = posters[0][1].texture
    assert any(_likeness(photographed(name), shown) > 0.9 for name in POSTERS)


def _likeness(photograph: np.ndarray, part: np.ndarray) -> float:
    """Return the best correlation of a part with a photograph, over scales of 0.5 to 1 of its largest."""
    largest = min(photograph.shape[0] / part.shape[0], photograph.shape[1] / part.shape[1])
    best = -1.0
    for share in np.linspace(0.5, 1, 26):
        size = tuple(max(2, int(share * largest * side)) for side in part.shape[::-1])
        found = cv2.matchTemplate(photograph, cv2.resize(part, size), cv2.TM_CCOEFF_NORMED)
        best = max(best, float(found.max()))
    return best
