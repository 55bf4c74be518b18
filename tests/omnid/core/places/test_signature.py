"""Signatures tell nearby places from others at any heading and in another light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omnid.core.places.signature import signature_of, similarities, thumbnail
from omnid.core.types.panorama import PaddedPanorama
from tests.omnid.core.scenery import RenderedCameras
from tests.simulation import corridor
from tests.simulation.paths import planar_poses


def similarity(a: PaddedPanorama, b: PaddedPanorama) -> float:
    """The largest correlation of two panoramas' thumbnails over all headings."""
    here, there = (signature_of(thumbnail(panorama)) for panorama in (a, b))
    return float(similarities(here, there[None])[0])


@pytest.fixture(scope="module")
def panoramas(cameras: RenderedCameras) -> list[PaddedPanorama]:
    """A place, the same one 0.2 m aside and turned by 2 rad, and one 1.5 m further on."""
    poses = planar_poses(np.array([[0.0, 0], [0.0, 0.2], [1.5, 0]]), np.array([0.0, 2.0, 0.0]))
    return [cameras.frame(k, T).lower for k, T in enumerate(poses)]


def test_a_place_is_similar_to_itself_at_any_heading_and_in_another_light(panoramas: list[PaddedPanorama]) -> None:
    here = panoramas[0]
    turned = np.roll(here.panorama, here.width // 3, axis=1)
    dimmer = PaddedPanorama(np.pad((0.7 * turned + 10).astype(np.uint8), ((0, 0), (16, 16)), mode="wrap"), 16)
    assert similarity(here, here) == pytest.approx(1.0, abs=1e-5)
    assert similarity(here, dimmer) > 0.95


def test_a_nearby_place_is_more_similar_than_another(cameras: RenderedCameras, panoramas: list[PaddedPanorama]) -> None:
    here, aside, further = panoramas
    elsewhere = replace(cameras, scene=corridor(7)).frame(9, np.eye(4)).lower
    assert similarity(here, aside) > max(similarity(here, further), similarity(here, elsewhere)) + 0.05


def test_nothing_is_similar_to_an_image_without_contrast() -> None:
    blank = PaddedPanorama(np.full((100, 532), 90, np.uint8), 16)
    assert similarity(blank, blank) == 0.0
