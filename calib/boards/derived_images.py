"""Images derived from a mirror image in which a board is easier to find, with the way back to its pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array

Image = NDArray[np.uint8]
# Larger images are not enlarged: their boards have enough pixels.
MAX_ENLARGED_PIXELS = 1_600_000
# Largest width of one turn of a log-polar strip, and its width in turns, so that boards across its ends are seen whole.
MAX_STRIP_PX, STRIP_TURNS = 2400, 1.3
# Inner radius of a log-polar strip, in parts of the image's smaller side.
STRIP_INNER_PART = 1 / 16
# Contrast limited adaptive histogram equalisation (CLAHE): clip limit, and number of tiles along each axis.
CLAHE_CLIP_LIMIT, CLAHE_TILES = 4.0, 8


@dataclass(frozen=True, slots=True)
class DerivedImage:
    """An image derived from the source image; to_source maps its pixels (N, 2) to source pixels (N, 2)."""

    image: Image
    to_source: Callable[[Array], Array]


def derived_images(image: Image) -> Iterator[DerivedImage]:
    """Yield the image and its derived images, the cheapest first."""
    yield DerivedImage(image, lambda pixels: pixels)
    local = cv2.createCLAHE(CLAHE_CLIP_LIMIT, (CLAHE_TILES,) * 2).apply(image).astype(np.uint8, copy=False)
    yield DerivedImage(local, lambda pixels: pixels)
    if image.size <= MAX_ENLARGED_PIXELS:
        double = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC).astype(np.uint8, copy=False)
        yield DerivedImage(double, lambda pixels: (pixels + 0.5) / 2 - 0.5)
    yield unrolled(image)


def unrolled(image: Image) -> DerivedImage:
    """Return the log-polar strip about the image's middle: azimuth to the right, logarithm of the radius upwards.

    It is conformal: squares stay square, and boards near the hub become larger and lose their fan shape.
    """
    height, width = image.shape
    strip = cv2.remap(image, *_strip_maps((height, width)), cv2.INTER_CUBIC).astype(np.uint8, copy=False)
    _, outer, scale = _strip_scale((height, width))
    middle = np.array([width - 1, height - 1]) / 2

    def to_source(pixels: Array) -> Array:
        azimuth, radius = pixels[:, 0] / scale, outer * np.exp(-pixels[:, 1] / scale)
        return np.asarray(middle + radius[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)]))

    return DerivedImage(strip, to_source)


def _strip_scale(shape: tuple[int, int]) -> tuple[float, float, float]:
    """Return inner and outer radius [px] of a strip, and its pixels per radian; shape: (H, W) of the image."""
    inner, outer = min(shape) * STRIP_INNER_PART, max(shape) / 2
    return inner, outer, min(MAX_STRIP_PX, 2 * np.pi * outer) / (2 * np.pi)


@lru_cache(maxsize=2)
def _strip_maps(shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the columns and rows (H, W) [px] of the image for each pixel of its strip, for cv2.remap.

    They are kept, because all images of a camera have one shape.
    """
    inner, outer, scale = _strip_scale(shape)
    azimuth = np.arange(int(STRIP_TURNS * 2 * np.pi * scale)) / scale
    radius = outer * np.exp(-np.arange(int(np.log(outer / inner) * scale)) / scale)
    u = (shape[1] - 1) / 2 + np.outer(radius, np.cos(azimuth))
    v = (shape[0] - 1) / 2 + np.outer(radius, np.sin(azimuth))
    return u.astype(np.float32), v.astype(np.float32)
