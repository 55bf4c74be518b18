"""Photographs as textures: they cover walls, floor and pictures, are sharp, and are those of the seed."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from tests.simulation import Scene, build
from tests.simulation.photographs import with_photographs

pytestmark = pytest.mark.skipif(find_spec("skimage") is None, reason="needs the files of scikit-image")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build("rooms", 3, 160, 4).scene


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
