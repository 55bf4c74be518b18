"""Derived images show the same corners, and their pixels lead back to the source."""

from __future__ import annotations

import numpy as np
import pytest

from calib.boards.corner_candidates import find_corners
from calib.boards.derived_images import derived_images
from tests.calib.boards.sheets import sheet


@pytest.mark.parametrize("number", [0, 1, 2])
def test_corners_found_in_a_derived_image_lead_back_to_the_source(number: int) -> None:
    seen = sheet()
    derived = list(derived_images(seen.image))[number]
    found = derived.to_source(find_corners(derived.image).pixels)
    assert np.linalg.norm(found[:, None] - seen.pixels, axis=2).min(axis=0).max() < 0.4


def test_the_strip_has_the_azimuth_to_the_right_and_the_radius_upwards() -> None:
    image = np.tile(np.where(np.arange(200) > 99.5, 200, 50).astype(np.uint8), (160, 1))
    strip = list(derived_images(image))[-1]
    pixels = np.array([[10.0, 5.0], [10.0, 60.0]])
    source = strip.to_source(pixels)
    radius = np.linalg.norm(source - (99.5, 79.5), axis=1)
    assert radius[0] > radius[1] and (source[:, 1] > 79.5).all() and (source[:, 0] > 99.5).all()
    assert strip.image[5, 10] == 200 and strip.image[5, round(np.pi * strip.image.shape[1] / (1.3 * 2 * np.pi))] == 50


def test_large_images_are_not_enlarged() -> None:
    assert [len(list(derived_images(np.zeros(shape, np.uint8)))) for shape in ((100, 100), (1300, 1300))] == [4, 3]
