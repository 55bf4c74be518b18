"""Parts that are fixed to a camera, learned from the views that a base has as it turns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.calibration.fixed_parts import HEADINGS, FixedParts
from omnid.core.types.panorama import PaddedPanorama

CYLINDER = Cylinder(872, 253, 86.0)
RING = slice(200, 216)  # rows of the reflection of a lens
SHOWN = np.ones((CYLINDER.height, CYLINDER.width), bool)
LIGHT_GREY = 60.0
PAD_PX, NOISE_GREY = 24, 1.0
TURN = [(n + 0.5) * math.tau / HEADINGS for n in range(HEADINGS)]


@lru_cache(maxsize=1)
def world() -> NDArray[np.float32]:
    """Return a panorama of texture of all sizes."""
    rng = np.random.default_rng(3)
    grey = np.full((CYLINDER.height, CYLINDER.width), 120.0, np.float32)
    for sigma_px, contrast_grey in ((1.0, 8.0), (4.0, 8.0), (12.0, 8.0)):
        noise = cv2.GaussianBlur(rng.normal(size=grey.shape), (0, 0), sigma_px)
        grey += (contrast_grey / noise.std() * noise).astype(np.float32)
    return grey


def seen(heading_rad: float, ring_grey: float = 0.0, columns: slice = slice(None)) -> PaddedPanorama:
    """Return the world at a heading, with light that is added by a reflection in some columns."""
    grey = np.roll(world(), round(heading_rad / math.tau * CYLINDER.width), axis=1)
    grey[RING, columns] += ring_grey
    noise = np.random.default_rng(round(1e3 * heading_rad)).normal(0.0, NOISE_GREY, grey.shape)
    image = np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)
    return PaddedPanorama(np.pad(image, ((0, 0), (PAD_PX, PAD_PX)), mode="wrap"), PAD_PX, NOISE_GREY)


def turned(heading_rad: float, x_m: float = 0.0) -> NDArray[np.float64]:
    """Return a pose (4, 4)."""
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading_rad]))
    T[0, 3] = x_m
    return T


def observed(pairs: Callable[[float], tuple[PaddedPanorama, PaddedPanorama]]) -> NDArray[np.bool_]:
    """Return the pixels that are fixed by the pairs of a turn."""
    parts = FixedParts(CYLINDER)
    for heading in TURN:
        parts.observe(turned(heading), *pairs(heading), SHOWN)
    assert parts.headings == HEADINGS
    return parts.pixels()


def test_a_reflection_is_found_within_a_turn_and_nothing_else() -> None:
    pixels = observed(lambda heading: (seen(heading), seen(heading, LIGHT_GREY)))
    rows = pixels.mean(axis=1)
    assert rows[RING].min() > 0.9
    # The band-pass spreads a border over its 17 rows of 139 a radian.
    assert not rows[: RING.start - 16].any() and not rows[RING.stop + 16 :].any()


def test_the_world_the_horizon_and_images_that_do_not_follow_the_heading_are_not_fixed() -> None:
    """Without the rows of the horizon a bar as high as the cameras would not be seen; wheels may carry the pose past
    images that do not change."""
    grey, still = np.zeros((CYLINDER.height, CYLINDER.width + 2 * PAD_PX), np.uint8), seen(0.0)
    grey[: round(CYLINDER.row0) + 8] = 60  # the sky, and hills
    before_hills = lambda heading: replace(seen(heading), image=seen(heading).image + grey)  # noqa: E731
    for pairs in (
        lambda heading: (seen(heading), seen(heading)),
        lambda heading: (before_hills(heading), before_hills(heading)),
        lambda _: (still, still),
    ):
        assert not observed(pairs).any()
