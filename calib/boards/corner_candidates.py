"""Corner candidates: points where four squares may meet, found as saddle points of grey with two crossing edges.

They are searched in an image and in those derived from it, in which a board is easier to find.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.boards.board import MAX_SIDE
from calib.models.camera import Array

Grey = NDArray[np.float32]
# Samples on the ring about a corner, about one a pixel because the largest one is 29 px around.
RING = 32
# Standard deviation of the Gaussian blur before grey levels of a ring are sampled.
BLUR_PX = 0.7
# Least contrast of a ring [grey levels].
MIN_CONTRAST = 6.0
# Largest ratio of the ring's odd part to its even part (standard deviations), because opposite sides of a corner have
# the same grey.
MAX_ODD = 0.6
# Least angle between the two edges of a corner.
MIN_CROSSING_RAD = np.deg2rad(18)
# Least second derivative at a saddle point [grey levels / px^2].
MIN_SADDLE = 0.6


@dataclass(frozen=True, slots=True)
class ScaleLevel:
    """A scale of the search: the image resized by scale and blurred; radius of the ring [resized px]."""

    scale: float
    blur_px: float
    ring_px: float


# Rings of 2.6, 4.6, 8.4 and 16.8 px of the image, each at most twice the last, so that squares of all sizes fit one.
LEVELS = (ScaleLevel(1.0, 0.8, 2.6), ScaleLevel(1.0, 1.4, 4.6), ScaleLevel(0.5, 1.2, 4.2), ScaleLevel(0.25, 1.2, 4.2))


@dataclass(frozen=True, slots=True)
class CornerCandidates:
    """Candidates for corners and the description of their rings."""

    pixels: Array  # (N, 2)
    angles: Array  # (N, 2) [rad] of the two edges, rising, in [0, pi)
    light: NDArray[np.bool_]  # (N,) True if the image is light between the first and the second edge
    contrast: Array  # (N,) [grey levels]
    quality: Array  # (N,) 0 to 1; 0: not a corner
    ring_px: Array  # (N,) radius of the ring

    def __len__(self) -> int:
        return len(self.pixels)

    def select(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> CornerCandidates:
        """Return the candidates of an index or mask."""
        return CornerCandidates(*(getattr(self, one.name)[chosen] for one in fields(self)))


def find_corners(image: NDArray[np.uint8]) -> CornerCandidates:
    """Find all candidates in an image (H, W) at all scales; of several at one place the best is kept."""
    levels = [_at_level(image, level) for level in LEVELS]
    parts = [np.concatenate([getattr(level, one.name) for level in levels]) for one in fields(CornerCandidates)]
    found = CornerCandidates(*parts)
    found = found.select(np.argsort(-found.quality * found.contrast, kind="stable"))
    # Candidates closer than half of their ring's radius are the same corner: neighbours are farther than the radius.
    return found.select(_suppress_duplicates(found.pixels, found.ring_px / 2))


def describe_corners(image: Grey, pixels: Array, ring_px: float | Array) -> CornerCandidates:
    """Describe the rings about pixels (N, 2) by even part, odd part and crossing edges; quality 0: not a corner."""
    radius = np.broadcast_to(np.asarray(ring_px, float), (len(pixels),))
    angle, half = 2 * np.pi * np.arange(RING) / RING, RING // 2
    ring = sample(image, pixels[:, None] + radius[:, None, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
    even, odd = (ring[:, :half] + ring[:, half:]) / 2, (ring[:, :half] - ring[:, half:]) / 2
    contrast = np.ptp(even, axis=1)
    ratio = odd.std(axis=1) / np.maximum(even.std(axis=1), 1e-6)
    angles, light, crossings = _edges(even - ((even.max(axis=1) + even.min(axis=1)) / 2)[:, None])
    between = np.minimum(angles[:, 1] - angles[:, 0], np.pi - (angles[:, 1] - angles[:, 0]))
    good = (crossings == 2) & (contrast >= MIN_CONTRAST) & (ratio < MAX_ODD) & (between > MIN_CROSSING_RAD)
    return CornerCandidates(pixels, angles, light, contrast, np.where(good, 1 - ratio, 0.0), radius)


def sample(image: Grey, pixels: Array) -> Array:
    """Return grey values (...) at pixels (..., 2), bilinear, with the border repeated."""
    flat = pixels.reshape(-1, 2).astype(np.float32)
    # cv2.remap expects images, not lists, so that samples are folded into a square.
    side = math.isqrt(len(flat)) + 1
    padded = np.zeros((side * side, 2), np.float32)
    padded[: len(flat)] = flat
    u, v = padded.T.reshape(2, side, side)
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.ravel()[: len(flat)].reshape(pixels.shape[:-1]), float)


def smoothed(image: NDArray[np.generic], blur_px: float) -> Grey:
    """Return the image (H, W) as float32 after a Gaussian blur."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px), np.float32)


def _at_level(image: NDArray[np.uint8], level: ScaleLevel) -> CornerCandidates:
    """Return the corners of one level, in pixels of the image itself."""
    shrunk = (
        image
        if level.scale == 1
        else cv2.resize(image, None, fx=level.scale, fy=level.scale, interpolation=cv2.INTER_AREA)
    )
    blurred = smoothed(shrunk, level.blur_px)
    places = _saddles(blurred, int(np.ceil(level.ring_px)))
    found = describe_corners(blurred, places, level.ring_px)
    found = found.select(found.quality > 0)
    return replace(found, pixels=(found.pixels + 0.5) / level.scale - 0.5, ring_px=found.ring_px / level.scale)


def _saddles(blurred: Grey, border: int) -> Array:
    """Return pixels (N, 2) of the strongest saddle points, refined by the second-order surface."""
    orders = ((1, 0, 1 / 8), (0, 1, 1 / 8), (2, 0, 1 / 4), (0, 2, 1 / 4), (1, 1, 1 / 4))
    derivatives = [cv2.Sobel(blurred, cv2.CV_32F, dx, dy, ksize=3, scale=scale) for dx, dy, scale in orders]
    _, _, xx, yy, xy = derivatives
    strength = xy * xy - xx * yy  # the negative determinant of the Hessian
    peak = (strength == cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > MIN_SADDLE**2)
    peak[:border], peak[-border:], peak[:, :border], peak[:, -border:] = False, False, False, False
    row, column = np.nonzero(peak)
    # So many that the largest board fits.
    best = np.argsort(-strength[row, column], kind="stable")[: (MAX_SIDE + 1) ** 2]
    row, column = row[best], column[best]
    x, y, xx, yy, xy = (derivative[row, column].astype(float) for derivative in derivatives)
    determinant = xx * yy - xy * xy
    step = np.column_stack([xy * y - yy * x, xy * x - xx * y]) / determinant[:, None]
    return np.asarray(np.column_stack([column, row]) + np.clip(step, -1, 1))


def _edges(wave: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Return edge angles (N, 2) [rad], light between them (N,), and edge counts (N,) of half rings (N, RING / 2)."""
    after = np.roll(wave, -1, axis=1)
    crossing = (wave > 0) != (after > 0)
    count = crossing.sum(axis=1)
    order = np.argsort(~crossing, axis=1, kind="stable")[:, :2]
    before, behind = (np.take_along_axis(values, order, axis=1) for values in (wave, after))
    part = before / np.where(before == behind, 1.0, before - behind)
    angles = (order + part) * np.pi / wave.shape[1]
    light = np.take_along_axis(after, order[:, :1], axis=1)[:, 0] > 0
    # An edge beyond the end of the half ring comes first.
    wrapped = angles[:, 1] >= np.pi
    angles[wrapped] = np.column_stack([angles[wrapped, 1] - np.pi, angles[wrapped, 0]])
    return angles, np.where(wrapped, ~light, light), count


def _suppress_duplicates(pixels: Array, reach: Array) -> NDArray[np.intp]:
    """Return indices of the points without an earlier, kept point within the reach [px] of one of the two."""
    if not len(pixels):
        return np.zeros(0, np.intp)
    pairs = cKDTree(pixels).query_pairs(float(reach.max()), output_type="ndarray")
    apart = np.linalg.norm(pixels[pairs[:, 0]] - pixels[pairs[:, 1]], axis=1)
    pairs = pairs[apart < reach[pairs].max(axis=1)]
    kept = np.ones(len(pixels), bool)
    # In order of the earlier point: it is known by then if that one is kept.
    for earlier, later in pairs[np.argsort(pairs[:, 0], kind="stable")].tolist():
        if kept[earlier]:
            kept[later] = False
    return np.flatnonzero(kept)


Image = NDArray[np.uint8]
# Larger images are not enlarged: their boards have enough pixels.
MAX_ENLARGED_PIXELS = 1_600_000
# Largest width of one turn of a log-polar strip, and its width in turns, so that boards across its ends are seen whole.
MAX_STRIP_PX, STRIP_TURNS = 2400, 1.3
# Inner radius of a log-polar strip, as a fraction of the image's smaller side.
STRIP_INNER_PART = 1 / 16


@dataclass(frozen=True, slots=True)
class DerivedImage:
    """An image derived from the source image; to_source maps its pixels (N, 2) to source pixels (N, 2)."""

    image: Image
    to_source: Callable[[Array], Array]


def derived_images(image: Image) -> Iterator[DerivedImage]:
    """Yield the image and its derived images, the cheapest first."""
    yield DerivedImage(image, lambda pixels: pixels)
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
