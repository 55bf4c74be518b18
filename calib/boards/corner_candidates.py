"""Corner candidates: points where four squares may meet, found as saddle points of grey with two crossing edges."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calib.boards.board import MAX_SIDE
from calib.models.camera import Array

Grey = NDArray[np.float32]
Image = NDArray[np.uint8]
# Samples on the ring about a corner: two a pixel.
RING = 32
# Standard deviation of the Gaussian blur before grey levels of a ring are sampled.
BLUR_PX = 0.7
# Largest ratio of the ring's odd part to its even part (standard deviations), because opposite sides of a corner have
# the same grey, and the edge of what hides a board does not.
MAX_ODD = 0.4


# Radius of the ring, and the scales of the image at which it is sampled, so that squares of all sizes fit one.
RING_PX, SCALES = 2.6, (1.0, 0.5, 0.25)


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
    levels = [_at_scale(image, scale) for scale in SCALES]
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
    good = (crossings == 2) & (ratio < MAX_ODD)
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


def smoothed(image: NDArray[np.generic]) -> Grey:
    """Return the image (H, W) as float32 after a Gaussian blur."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX), np.float32)


def _at_scale(image: NDArray[np.uint8], scale: float) -> CornerCandidates:
    """Return the corners at one scale, in pixels of the image itself."""
    blurred = smoothed(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    found = describe_corners(blurred, _saddles(blurred, math.ceil(RING_PX)), RING_PX)
    found = found.select(found.quality > 0)
    return replace(found, pixels=(found.pixels + 0.5) / scale - 0.5, ring_px=found.ring_px / scale)


def _saddles(blurred: Grey, border: int) -> Array:
    """Return pixels (N, 2) of the strongest saddle points, refined by the second-order surface."""
    orders = ((1, 0, 1 / 8), (0, 1, 1 / 8), (2, 0, 1 / 4), (0, 2, 1 / 4), (1, 1, 1 / 4))
    derivatives = [cv2.Sobel(blurred, cv2.CV_32F, dx, dy, ksize=3, scale=scale) for dx, dy, scale in orders]
    _, _, xx, yy, xy = derivatives
    strength = xy * xy - xx * yy  # the negative determinant of the Hessian
    peak = (strength == cv2.dilate(strength, np.ones((3, 3), np.uint8))) & (strength > 0)
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
