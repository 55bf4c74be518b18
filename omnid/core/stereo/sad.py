"""Sums of absolute differences along the columns of two panoramas (Dang et al. 2012, eq. (1))."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Costs = NDArray[np.uint16]
Indices = NDArray[np.intp]

NO_MATCH = np.uint16(65535)  # cost of a match outside the image; the largest of uint16, so that it is never chosen
MIN_SLOPE = 1.0  # grey levels per pixel of the sum, so that a flat minimum divides by no zero


class SadVolume:
    """SAD of every pixel of the lower panorama and the pixel d rows below it in the upper one, d = 0 .. D-1.

    The planes (D, H, W) uint16 are allocated once. A window of up to 15x15 keeps the sums below 65535.
    """

    def __init__(self, shape: tuple[int, int], disparities: int, window_px: int) -> None:
        self.window_px = window_px
        self.planes = np.full((min(disparities, shape[0]), *shape), NO_MATCH, np.uint16)
        self._difference = np.empty(shape, np.uint8)

    def fill(self, lower: Image, upper: Image) -> None:
        """Compute the planes for a pair of panoramas (H, W)."""
        window = (self.window_px, self.window_px)
        for d, plane in enumerate(self.planes):
            rows = lower.shape[0] - d
            difference = cv2.absdiff(lower[:rows], upper[d:], self._difference[:rows])
            cv2.boxFilter(
                difference, cv2.CV_16U, window, plane[:rows], normalize=False, borderType=cv2.BORDER_REPLICATE
            )

    def at(self, pixels: Indices) -> Costs:
        """Return the costs (D, N) of pixels of the lower panorama (flat indices)."""
        costs = np.empty((len(self.planes), len(pixels)), np.uint16)
        for plane, row in zip(self.planes, costs, strict=True):
            np.take(plane.reshape(-1), pixels, out=row, mode="clip")
        return costs

    def around(self, pixels: Indices, disparity: Indices, reach: int) -> Costs:
        """Return costs (2 reach + 1, N) of pixels (flat indices) at disparity - reach .. + reach; NO_MATCH outside."""
        searched = disparity[None] + np.arange(-reach, reach + 1)[:, None]
        inside = (searched >= 0) & (searched < len(self.planes))
        size = self.planes[0].size
        return np.where(inside, self.planes.reshape(-1)[np.where(inside, searched, 0) * size + pixels], NO_MATCH)

    def best_from_upper(self, pixels: Indices, disparity: Indices) -> tuple[Indices, Costs]:
        """Return the best disparities (N,) of the upper panorama's pixels, and their costs (N,): the left-right check.

        The upper pixels are given by pixels (N,) of the lower panorama and their disparities (N,).
        """
        width = self.planes.shape[2]
        upper = pixels + disparity * width
        best = np.full(len(pixels), NO_MATCH, np.uint16)
        choice = np.zeros(len(pixels), np.intp)
        for d, plane in enumerate(self.planes):
            cost = np.take(plane.reshape(-1), np.maximum(upper - d * width, 0), mode="clip")
            better = (cost < best) & (upper >= d * width)
            best[better], choice[better] = cost[better], d
        return choice, best


def local_minima(costs: Costs, limit: Costs | int) -> NDArray[np.bool_]:
    """Return flags (D, N) of the costs that are minima along D and not above a limit; the ends of D are no minima."""
    inner = (costs[1:-1] < costs[:-2]) & (costs[1:-1] <= costs[2:]) & (costs[1:-1] <= limit) & (costs[2:] < NO_MATCH)
    minima = np.zeros(costs.shape, bool)
    minima[1:-1] = inner
    return minima


def subpixel(costs: Costs, disparity: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return disparities (N,) refined to where two lines of equal slope through the minimum's sides meet.

    A sum of absolute differences is V-shaped about its minimum, so lines fit it better than a parabola.
    """
    each = np.arange(costs.shape[1])
    middle = np.clip(disparity, 1, len(costs) - 2)
    before, at, after = (costs[middle + k, each].astype(np.float32) for k in (-1, 0, 1))
    steeper = np.maximum(np.maximum(before, after) - at, MIN_SLOPE)
    return np.asarray(middle + np.clip((before - after) / (2 * steeper), -0.5, 0.5), np.float32)
