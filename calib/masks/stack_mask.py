"""Mask from a stack of frames: it excludes the pixels beyond the rim, the hub and the struts."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.masks.rim import find_rim
from calib.models.camera import Mask

Image = NDArray[np.uint8]
MIN_FRAMES = 5  # Fewer images show no mask.
MAX_FRAMES = 64  # Most images, so that the memory is bounded: 128 MB of images of 2 megapixels.
# A strut is darker than this part of the median light level in all frames, and changes less than this part of the
# median change.
DARK_PART = 0.35
STILL_PART = 0.35
# Percentiles that stand for the light and the dark level of a pixel over time, so that single glints do not count.
LIGHT_PERCENTILE, DARK_PERCENTILE = 95, 5
# Morphology: opening removes specks, closing fills gaps; components smaller than this part of the ring are dropped;
# the rest is dilated by the blur at its edges.
OPEN_PX, CLOSE_PX = 3, 7
MIN_SPECK_PART = 5e-4
EDGE_PX = 2


def find_mask(frames: Sequence[Image], center: tuple[float, float]) -> Mask:
    """Find the mask of frames (H, W) uint8 that show different views; its image is 255 for pixels of the world.

    center (u, v) [px]: the camera's, or a guess. Raises CalibError if frames are too few or show no rim.
    """
    if len(frames) < MIN_FRAMES:
        raise CalibError(f"mask: expected at least {MIN_FRAMES} frames of different views, found {len(frames)}")
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().astype(int)
    stack = np.stack([frames[index] for index in chosen])
    brightest = stack.max(axis=0)
    rim = find_rim(brightest, center)
    if rim is None:
        raise CalibError("mask: no rim of a mirror is found in these frames; draw the mask by hand, or leave it out")
    shown = _disc(brightest.shape, rim, rim.outer_px) & ~_disc(brightest.shape, rim, rim.inner_px)
    shown &= ~_fittings(stack, shown)
    return Mask(rim.center, rim.inner_px, rim.outer_px, np.where(shown, 255, 0).astype(np.uint8))


def _disc(shape: tuple[int, ...], rim: Mask, radius_px: float) -> NDArray[np.bool_]:
    v, u = np.indices(shape)
    if radius_px <= 0:
        return np.zeros(shape, bool)
    return np.asarray(np.hypot(u - rim.center[0], v - rim.center[1]) <= radius_px)


def _fittings(stack: NDArray[np.uint8], shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask of struts: pixels of the ring shown that are dark and unchanged in all frames."""
    high, low = np.percentile(stack, LIGHT_PERCENTILE, axis=0), np.percentile(stack, DARK_PERCENTILE, axis=0)
    change = high - low
    usual_light, usual_change = np.median(high[shown]), np.median(change[shown])
    still = shown & (high < DARK_PART * usual_light) & (change < STILL_PART * usual_change)
    whole = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_OPEN, np.ones((OPEN_PX, OPEN_PX), np.uint8))
    whole = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((CLOSE_PX, CLOSE_PX), np.uint8))
    count, labels, numbers, _ = cv2.connectedComponentsWithStats(whole)
    large = [n for n in range(1, count) if numbers[n, cv2.CC_STAT_AREA] > MIN_SPECK_PART * shown.sum()]
    kept = np.isin(labels, large).astype(np.uint8)
    return np.asarray(cv2.dilate(kept, np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)) > 0)
