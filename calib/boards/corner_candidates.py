"""Points of a image where four squares of a checkerboard may meet: saddles of brightness with two crossing edges."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.models.camera import Array

Grey = NDArray[np.float32]
RING = 32
# A corner's ring: light and dark must differ by so many grey levels, and opposite sides be alike: the odd part of the
# ring may have this part of the even one's size.
MIN_CONTRAST = 6.0
MAX_ODD = 0.6
# The two edges of a corner cross at no less than this.
MIN_CROSSING_RAD = np.deg2rad(18)
MAX_PER_LEVEL = 4000
SAME_PX = 2.0
REMAP_COLUMNS = 1024  # cv2.remap takes images, not lists


@dataclass(frozen=True, slots=True)
class Level:
    """How large a corner is looked for: the image shrunk by scale, blurred, a ring of that radius [shrunk px]."""

    scale: float
    blur_px: float
    ring_px: float


LEVELS = (Level(1.0, 0.8, 2.6), Level(1.0, 1.4, 4.6), Level(0.5, 1.2, 4.2), Level(0.25, 1.2, 4.2))


@dataclass(frozen=True, slots=True)
class Corners:
    """Candidates: pixels (N, 2), edge angles (N, 2) [rad] rising in [0, pi), whether the image is light between the
    first and the second (N,), ring contrast (N,) in grey levels, quality (N,) 0 to 1, ring radius (N,) [px].
    """

    pixels: Array
    angles: Array
    light: NDArray[np.bool_]
    contrast: Array
    quality: Array
    ring_px: Array

    def __len__(self) -> int:
        return len(self.pixels)

    def only(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> Corners:
        """The candidates of that selection."""
        return Corners(self.pixels[chosen], self.angles[chosen], self.light[chosen], self.contrast[chosen],
                       self.quality[chosen], self.ring_px[chosen])


def find_corners(image: NDArray[np.uint8]) -> Corners:
    """All candidates of a image (H, W), from fine to coarse; of several at one place the best is kept."""
    levels = [level for level in LEVELS if min(image.shape) * level.scale >= 100 or level.scale == 1.0]
    return _merged([_at_level(image, level) for level in levels])


def look_at(image: Grey, pixels: Array, ring_px: float | Array) -> Corners:
    """What the rings about pixels (N, 2) look like, whatever they are; quality 0 where it is no corner."""
    radius = np.broadcast_to(np.asarray(ring_px, float), (len(pixels),))
    angle = 2 * np.pi * np.arange(RING) / RING
    ring = sample(image, pixels[:, None] + radius[:, None, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
    return _judged(ring, pixels, radius)


def sample(image: Grey, pixels: Array) -> Array:
    """Grey values (...) of pixels (..., 2), bilinear, the border repeated."""
    flat = pixels.reshape(-1, 2).astype(np.float32)
    padded = np.zeros((max(1, -(-len(flat) // REMAP_COLUMNS)) * REMAP_COLUMNS, 2), np.float32)
    padded[:len(flat)] = flat
    u, v = padded.T.reshape(2, -1, REMAP_COLUMNS)
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values.ravel()[:len(flat)].reshape(pixels.shape[:-1]), float)


def smoothed(image: NDArray[np.generic], blur_px: float) -> Grey:
    """The image (H, W) as float32, blurred."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px), np.float32)


def _at_level(image: NDArray[np.uint8], level: Level) -> Corners:
    shrunk = image if level.scale == 1 else cv2.resize(image, None, fx=level.scale, fy=level.scale,
                                                       interpolation=cv2.INTER_AREA)
    blurred = smoothed(shrunk, level.blur_px)
    places = _saddles(blurred, int(np.ceil(level.ring_px)))
    found = look_at(blurred, places, level.ring_px)
    found = found.only(found.quality > 0)
    return Corners((found.pixels + 0.5) / level.scale - 0.5, found.angles, found.light, found.contrast, found.quality,
                   found.ring_px / level.scale)


def _saddles(blurred: Grey, border: int) -> Array:
    """Pixels (N, 2) of the strongest saddles, to a fraction of a pixel by the second-order surface."""
    strength, derivatives = _saddle_strength(blurred)
    peak = (strength == cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > (MIN_CONTRAST / 10) ** 2)
    peak[:border], peak[-border:], peak[:, :border], peak[:, -border:] = False, False, False, False
    row, column = np.nonzero(peak)
    best = np.argsort(-strength[row, column], kind="stable")[:MAX_PER_LEVEL]
    row, column = row[best], column[best]
    x, y, xx, yy, xy = (derivative[row, column].astype(float) for derivative in derivatives)
    determinant = xx * yy - xy * xy
    step = np.column_stack([xy * y - yy * x, xy * x - xx * y]) / determinant[:, None]
    return np.asarray(np.column_stack([column, row]) + np.clip(step, -1, 1))


def _saddle_strength(blurred: Grey) -> tuple[Grey, list[Grey]]:
    """Minus the Hessian's determinant, and the derivatives x, y, xx, yy, xy."""
    orders = ((1, 0, 1 / 8), (0, 1, 1 / 8), (2, 0, 1 / 4), (0, 2, 1 / 4), (1, 1, 1 / 4))
    derivatives = [np.asarray(cv2.Sobel(blurred, cv2.CV_32F, dx, dy, ksize=3, scale=scale), np.float32)
                   for dx, dy, scale in orders]
    _, _, xx, yy, xy = derivatives
    return np.asarray(xy * xy - xx * yy, np.float32), derivatives


def _judged(ring: Array, pixels: Array, radius: Array) -> Corners:
    half = RING // 2
    even, odd = (ring[:, :half] + ring[:, half:]) / 2, (ring[:, :half] - ring[:, half:]) / 2
    middle = (even.max(axis=1) + even.min(axis=1)) / 2
    wave = even - middle[:, None]
    contrast = np.ptp(even, axis=1)
    ratio = odd.std(axis=1) / np.maximum(even.std(axis=1), 1e-6)
    angles, light, crossings = _edges(wave)
    between = np.minimum(angles[:, 1] - angles[:, 0], np.pi - (angles[:, 1] - angles[:, 0]))
    good = (crossings == 2) & (contrast >= MIN_CONTRAST) & (ratio < MAX_ODD) & (between > MIN_CROSSING_RAD)
    quality = np.where(good, 1 - ratio / MAX_ODD * 0.9, 0.0)
    return Corners(pixels, angles, light, contrast, quality, radius)


def _edges(wave: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Edge angles (N, 2) [rad], light between them, and the number of edges (N,), of half rings (N, RING / 2)."""
    after = np.roll(wave, -1, axis=1)
    crossing = (wave > 0) != (after > 0)
    count = crossing.sum(axis=1)
    order = np.argsort(~crossing, axis=1, kind="stable")[:, :2]
    before, behind = (np.take_along_axis(values, order, axis=1) for values in (wave, after))
    part = before / np.where(before == behind, 1.0, before - behind)
    angles = (order + part) * np.pi / wave.shape[1]
    light = np.take_along_axis(after, order[:, :1], axis=1)[:, 0] > 0
    wrapped = angles[:, 1] >= np.pi  # the second edge falls past the half ring's end and comes first
    angles[wrapped] = np.column_stack([angles[wrapped, 1] - np.pi, angles[wrapped, 0]])
    return angles, np.where(wrapped, ~light, light), count


def _merged(levels: list[Corners]) -> Corners:
    """Everything found, each place once: the best of those that lie within one another's rings' inner half."""
    both = Corners(*(np.concatenate([getattr(level, name) for level in levels])
                     for name in ("pixels", "angles", "light", "contrast", "quality", "ring_px")))
    worth = both.quality * np.minimum(1, both.contrast / 40)
    both = both.only(np.argsort(-worth, kind="stable"))
    return both.only(_first_of_each_place(both.pixels, np.maximum(SAME_PX, 0.35 * both.ring_px)))


def _first_of_each_place(pixels: Array, reach: Array) -> NDArray[np.intp]:
    """Indices of the points that have no earlier one within their reach [px]."""
    cells: dict[tuple[int, int], list[int]] = {}
    side, kept = float(reach.max(initial=SAME_PX)), []
    for index, (u, v) in enumerate(pixels):
        cell = (int(u // side), int(v // side))
        near = [j for du in (-1, 0, 1) for dv in (-1, 0, 1) for j in cells.get((cell[0] + du, cell[1] + dv), ())]
        if not any(np.hypot(*(pixels[j] - pixels[index])) < max(reach[j], reach[index]) for j in near):
            cells.setdefault(cell, []).append(index)
            kept.append(index)
    return np.array(kept, dtype=np.intp)
