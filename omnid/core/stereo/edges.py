"""Where matching is worth while: edges of the blurred panorama (Dang et al. 2012, section III.A)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def smooth(image: Image, sigma_px: float) -> Image:
    """The image blurred by a Gaussian, against the noise of single pixels; sigma 0 leaves it alone."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8) if sigma_px > 0 else image


def edge_pixels(smoothed: Image, valid: NDArray[np.bool_], threshold: int, limit: int) -> NDArray[np.intp]:
    """Flat indices, ascending, of pixels whose Sobel response along the column is a maximum above a threshold.

    Only the change along the column tells a match apart from its neighbours there, so only it counts; of each edge
    its crest alone is kept. threshold in units of the 3x3 Sobel (8 per grey level and pixel). Where more than limit
    remain, every n-th is taken, evenly over the image.
    """
    response = cv2.convertScaleAbs(cv2.Sobel(smoothed, cv2.CV_16S, 0, 1), alpha=0.5)
    crest = (response[1:-1] >= response[:-2]) & (response[1:-1] > response[2:]) & (response[1:-1] > threshold // 2)
    chosen = np.flatnonzero(crest & valid[1:-1]) + smoothed.shape[1]
    return np.asarray(chosen[:: max(1, -(-len(chosen) // limit))])
