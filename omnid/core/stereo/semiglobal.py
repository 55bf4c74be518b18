"""Semi-global matching at half the resolution, refined at full resolution by the SAD near it.

Where a texture repeats, the window of a pixel cannot distinguish its candidates. The path costs of Hirschmueller 2008
carry the answer from where it is unambiguous. OpenCV's StereoSGBM (5 paths) computes them on transposed panoramas; the
SAD at full resolution then searches near this prior only.
"""

from __future__ import annotations

from typing import NamedTuple

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


Floats = NDArray[np.float32]

BLOCK_PX = 3  # side of StereoSGBM's matching window at the prior's resolution; the least of OpenCV's range of 3 to 11
SMALL_STEP_PENALTY = 100  # Penalty of a change of disparity by one, because walls are smooth.
LARGE_STEP_PENALTY = 3200  # Penalty of a larger change, because depth edges are rare.
LEFT_RIGHT_PX = 1  # largest disagreement of the disparities of both panoramas; as in OpenCV's samples
PREFILTER_CAP = 31  # StereoSGBM limits the gradients that it compares to this; by trial on development seeds.
SUBPIXEL = 16  # StereoSGBM returns sixteenths of a pixel; exact, by OpenCV
STEP_ROWS = 16  # StereoSGBM searches a multiple of this number of disparities; exact, by OpenCV
SCALE = 2  # the prior is computed at half the resolution, because at a quarter the courses of a brick wall are one grey
FILL_PX = 5  # Unknown pixels of the prior take the largest disparity within this distance, so that none is a hole.
REACH_PX = 2  # The search reaches this far from the prior, because a pixel of the prior is two pixels here.


class ColumnShift(NamedTuple):
    """Columns by which pixels are displaced in the upper panorama: the rig moved between the exposures."""

    at_infinity: Floats  # (H, W) px
    per_disparity: Floats  # (H, W) px/px


class SemiGlobalPrior:
    """Computes disparities of the lower panorama from small images; keeps OpenCV's buffers.

    One thread may use it at a time.
    """

    def __init__(self, disparities: int) -> None:
        self._rows = STEP_ROWS * max(1, -(-disparities // (SCALE * STEP_ROWS)))  # searched at the prior's resolution
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self._rows,
            blockSize=BLOCK_PX,
            P1=SMALL_STEP_PENALTY,
            P2=LARGE_STEP_PENALTY,
            disp12MaxDiff=LEFT_RIGHT_PX,
            preFilterCap=PREFILTER_CAP,
            uniquenessRatio=0,
            mode=cv2.STEREO_SGBM_MODE_SGBM,
        )

    def disparity(self, lower: Image, upper: Image) -> tuple[Floats, NDArray[np.bool_]]:
        """Return disparities (H, W) float32 [px at full size], good to about a pixel, and flags of the known ones.

        An unknown pixel has the largest disparity of its known neighbours, or 0 where there are none.
        """
        found = self._matcher.compute(self._transposed_small(lower), self._transposed_small(upper))
        small = np.maximum(found[:, : self._rows - 1 : -1].T, 0)
        near = cv2.dilate(small, np.ones((FILL_PX, FILL_PX), np.uint8))
        filled = np.where(small > 0, small, near).astype(np.float32) * np.float32(SCALE / SUBPIXEL)
        size = lower.shape[::-1]
        known = cv2.resize((small > 0).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        return np.asarray(cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR), np.float32), known.view(bool)

    def _transposed_small(self, panorama: Image) -> Image:
        """Return the panorama at the prior's size, transposed and mirrored: columns become rows, searched leftwards.

        StereoSGBM skips as many pixels at the start of a row as it searches; the repeated border fills them.
        """
        small = cv2.resize(panorama, None, fx=1 / SCALE, fy=1 / SCALE, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(cv2.copyMakeBorder(small, 0, self._rows, 0, 0, cv2.BORDER_REPLICATE).T[:, ::-1])


class WarpedSad:
    """SAD of pixels near a prior: the upper panorama is warped by the prior, so that a few shifts are compared at once.

    With the warped panorama W(y) = upper(y + d(y)), a pixel whose SAD against W is least at the shift k has the
    disparity k + d(y + k).
    """

    def __init__(self, shape: tuple[int, int], window_px: int) -> None:
        self._window = (window_px, window_px)
        self._columns, self._rows = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape[::-1]))

    def costs(
        self, lower: Image, upper: Image, prior: Floats, pixels: Indices, column_shift: ColumnShift | None = None
    ) -> Costs:
        """Return the costs (2 REACH_PX + 1, N) of pixels (flat indices) of the lower panorama, by shift."""
        height, columns = len(lower), self._columns
        if column_shift is not None:
            columns = columns + column_shift.at_infinity + column_shift.per_disparity * prior
        warped = cv2.remap(upper, columns, self._rows + prior, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        padded = cv2.copyMakeBorder(warped, REACH_PX, REACH_PX, 0, 0, cv2.BORDER_REPLICATE)
        costs = np.empty((2 * REACH_PX + 1, len(pixels)), np.uint16)
        for shift, row in enumerate(costs):
            difference = cv2.absdiff(lower, padded[shift : shift + height])
            plane = cv2.boxFilter(
                difference, cv2.CV_16U, self._window, normalize=False, borderType=cv2.BORDER_REPLICATE
            )
            np.take(plane.reshape(-1), pixels, out=row, mode="clip")
        return costs


def refined(prior: Floats, pixels: Indices, costs: Costs, step: Indices) -> Floats:
    """Return the disparities (N,) of pixels whose cost is least at a step (N,) of costs, to fractions of a pixel."""
    height, width = prior.shape
    shift = subpixel(costs, step) - REACH_PX
    row = pixels // width + shift
    above = np.clip(np.floor(row).astype(np.intp), 0, height - 2)
    before, after = (prior.reshape(-1)[(above + k) * width + pixels % width] for k in (0, 1))
    along = np.clip(row - above, 0, 1).astype(np.float32)
    return np.asarray(shift + before + along * (after - before), np.float32)
