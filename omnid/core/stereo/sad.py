"""Sums of absolute differences along the columns of two panoramas (Dang et al. 2012, eq. (1))."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Costs = NDArray[np.uint16]
Indices = NDArray[np.intp]

NEVER = np.uint16(65535)  # the cost of a match outside the image


class SadVolume:
    """SAD of every pixel of the lower panorama with the pixel d rows below it in the upper one, d = 0 .. D-1.

    The planes (D, H, W) uint16 are allocated once. A window of up to 15x15 keeps the sums below 65535.
    """

    def __init__(self, shape: tuple[int, int], disparities: int, window_px: int) -> None:
        self.window_px = window_px
        self.planes = np.full((min(disparities, shape[0]), *shape), NEVER, np.uint16)
        self._difference = np.empty(shape, np.uint8)

    def fill(self, lower: Image, upper: Image, disparities: range | None = None) -> None:
        """Computes the planes for a pair of panoramas (H, W): all, or those of the disparities asked for."""
        window = (self.window_px, self.window_px)
        for d in disparities or range(len(self.planes)):
            rows, plane = lower.shape[0] - d, self.planes[d]
            difference = cv2.absdiff(lower[:rows], upper[d:], self._difference[:rows])
            cv2.boxFilter(difference, cv2.CV_16U, window, plane[:rows], normalize=False,
                          borderType=cv2.BORDER_REPLICATE)

    def at(self, pixels: Indices) -> Costs:
        """Costs (D, N) of the lower panorama's pixels (flat indices)."""
        costs = np.empty((len(self.planes), len(pixels)), np.uint16)
        for plane, row in zip(self.planes, costs, strict=True):
            np.take(plane.reshape(-1), pixels, out=row, mode="clip")
        return costs

    def around(self, pixels: Indices, disparity: Indices, reach: int) -> Costs:
        """Costs (2 reach + 1, N) of pixels (flat indices) at disparity - reach .. disparity + reach; NEVER outside."""
        wanted = disparity[None] + np.arange(-reach, reach + 1)[:, None]
        inside = (wanted >= 0) & (wanted < len(self.planes))
        size = self.planes[0].size
        return np.where(inside, self.planes.reshape(-1)[np.where(inside, wanted, 0) * size + pixels], NEVER)

    def seen_from_upper(self, pixels: Indices, disparity: Indices) -> tuple[Indices, Costs]:
        """The disparity that the upper panorama's pixel would choose and its cost, (N,) each.

        For lower pixels and their disparities.
        """
        width = self.planes.shape[2]
        upper = pixels + disparity * width
        best = np.full(len(pixels), NEVER, np.uint16)
        choice = np.zeros(len(pixels), np.intp)
        for d, plane in enumerate(self.planes):
            cost = np.take(plane.reshape(-1), np.maximum(upper - d * width, 0), mode="clip")
            better = (cost < best) & (upper >= d * width)
            best[better], choice[better] = cost[better], d
        return choice, best


def local_minima(costs: Costs, limit: Costs | int) -> NDArray[np.bool_]:
    """Which of costs (D, N) are minima along D and not above a limit; the ends of the range are none."""
    inner = (costs[1:-1] < costs[:-2]) & (costs[1:-1] <= costs[2:]) & (costs[1:-1] <= limit) & (costs[2:] < NEVER)
    minima = np.zeros(costs.shape, bool)
    minima[1:-1] = inner
    return minima


def subpixel(costs: Costs, disparity: NDArray[np.intp]) -> NDArray[np.float32]:
    """Disparities (N,) with the fraction at which two lines of equal slope through the minimum's sides would meet.

    A sum of absolute differences is V-shaped about its minimum, so lines fit it better than a parabola.
    """
    each = np.arange(costs.shape[1])
    middle = np.clip(disparity, 1, len(costs) - 2)
    before, at, after = (costs[middle + k, each].astype(np.float32) for k in (-1, 0, 1))
    steeper = np.maximum(np.maximum(before, after) - at, 1.0)
    return np.asarray(middle + np.clip((before - after) / (2 * steeper), -0.5, 0.5), np.float32)
