"""Sums of absolute differences along the columns of two panoramas: Dang et al. 2012, eq. (1)."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Costs = NDArray[np.uint16]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

NO_MATCH: Final = np.uint16(65535)  # cost of a match outside the image; the largest of uint16, so that none chooses it
MIN_SLOPE: Final = 1.0  # grey levels per pixel of the sum, so that a flat minimum divides by no zero


def sad(lower: Image, upper: Image, window_px: int) -> Costs:
    """Return the SAD (H, W) of windows about the same pixels of two images; a window of up to 15 px fits 16 bits."""
    window, border = (window_px, window_px), cv2.BORDER_REPLICATE
    found = cv2.boxFilter(cv2.absdiff(lower, upper), cv2.CV_16U, window, normalize=False, borderType=border)
    return np.asarray(found, np.uint16)


class SadVolume:
    """SAD of every pixel of the lower panorama and the pixel d rows below it in the upper one, d = 0 .. D-1.

    The planes (D, H, W) uint16 are allocated once.
    """

    def __init__(self, shape: tuple[int, int], disparities: int, window_px: int) -> None:
        self._window_px = window_px
        self._planes = np.full((min(disparities, shape[0]), *shape), NO_MATCH, np.uint16)

    def fill(self, lower: Image, upper: Image) -> None:
        """Compute the planes for a pair of panoramas (H, W)."""
        for d, plane in enumerate(self._planes):
            rows = len(lower) - d
            plane[:rows] = sad(lower[:rows], upper[d:], self._window_px)

    def at(self, pixels: Indices) -> Costs:
        """Return the costs (D, N) of pixels of the lower panorama (flat indices)."""
        return np.array([np.take(plane.reshape(-1), pixels, mode="clip") for plane in self._planes])

    def best_from_upper(self, pixels: Indices, disparity: Indices) -> tuple[Indices, Costs]:
        """Return the best disparities (N,) of the upper panorama's pixels, and their costs (N,): the left-right check.

        The upper pixels are given by pixels (N,) of the lower panorama and their disparities (N,).
        """
        width = self._planes.shape[2]
        upper = pixels + disparity * width
        best = np.full(len(pixels), NO_MATCH, np.uint16)
        choice = np.zeros(len(pixels), np.intp)
        for d, plane in enumerate(self._planes):
            cost = np.take(plane.reshape(-1), np.maximum(upper - d * width, 0), mode="clip")
            better = (cost < best) & (upper >= d * width)
            best[better], choice[better] = cost[better], d
        return choice, best


def local_minima(costs: Costs, limit: Costs | int) -> Flags:
    """Return flags (D, N) of the costs that are minima along D and not above a limit; the ends of D are no minima."""
    minima = np.zeros(costs.shape, bool)
    before, at, after = costs[:-2], costs[1:-1], costs[2:]
    minima[1:-1] = (at < before) & (at <= after) & (at <= limit) & (after < NO_MATCH)
    return minima


def subpixel(costs: Costs, disparity: Indices) -> Floats:
    """Return disparities (N,) refined to where two lines of equal slope through the minimum's sides meet.

    A sum of absolute differences is V-shaped about its minimum, so lines fit it better than a parabola.
    """
    each = np.arange(costs.shape[1])
    middle = np.clip(disparity, 1, len(costs) - 2)
    before, at, after = (costs[middle + k, each].astype(np.float32) for k in (-1, 0, 1))
    steeper = np.maximum(np.maximum(before, after) - at, MIN_SLOPE)
    return np.asarray(middle + np.clip((before - after) / (2 * steeper), -0.5, 0.5), np.float32)
