"""Edge detection: choose the pixels that are matched (Dang et al. 2012, section III.A)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

RESPONSE_SCALE = 0.5  # because a 3x3 Sobel of 8-bit images reaches 1020: half of it and less is kept in 8 bits


def smooth(image: Image, sigma_px: float) -> Image:
    """Return the image blurred by a Gaussian against the noise of single pixels; sigma 0 returns it unchanged."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8) if sigma_px > 0 else image


def edge_pixels(smoothed: Image, valid: NDArray[np.bool_], threshold: int, limit: int) -> NDArray[np.intp]:
    """Return flat indices, ascending, of pixels where the Sobel response along the column is a maximum.

    Only a change along the column distinguishes a match from its neighbours there, so only that is measured, and only
    the crest of each edge is kept. threshold: least response, in units of the 3x3 Sobel (8 per grey level and pixel).
    If more than limit remain, every n-th is taken, evenly over the image.
    """
    response = cv2.convertScaleAbs(cv2.Sobel(smoothed, cv2.CV_16S, 0, 1), alpha=RESPONSE_SCALE)
    least = int(threshold * RESPONSE_SCALE)
    crest = (response[1:-1] >= response[:-2]) & (response[1:-1] > response[2:]) & (response[1:-1] > least)
    chosen = np.flatnonzero(crest & valid[1:-1]) + smoothed.shape[1]
    return np.asarray(chosen[:: max(1, -(-len(chosen) // limit))])
