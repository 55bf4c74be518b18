"""Semi-global matching at half the resolution, refined at full resolution by the SAD near it.

SAD: sums of absolute differences along the columns of two panoramas, Dang et al. 2012, eq. (1).

Where a texture repeats, the window of a pixel cannot distinguish its candidates. The path costs of Hirschmueller 2008
carry the answer from where it is unambiguous. OpenCV's StereoSGBM (5 paths) computes them on transposed panoramas; the
SAD at full resolution then searches near this prior only.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Costs = NDArray[np.uint16]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]
Flags = NDArray[np.bool_]

NO_MATCH: Final = np.uint16(65535)  # cost of a match outside the image; the largest of uint16, so that none chooses it
# Largest disagreement of the disparities that both panoramas choose; as in OpenCV's samples (disp12MaxDiff).
LEFT_RIGHT_PX: Final = 1
MIN_SLOPE: Final = 1.0  # grey levels per pixel of the sum, so that a flat minimum divides by no zero
BLOCK_PX: Final = 3  # side of StereoSGBM's matching window at the prior's resolution; the least of its range of 3 to 11
SMALL_STEP_PENALTY: Final = 100  # Penalty of a change of disparity by one, because walls are smooth.
LARGE_STEP_PENALTY: Final = 3200  # Penalty of a larger change, because depth edges are rare.
PREFILTER_CAP: Final = 31  # StereoSGBM limits the gradients that it compares to this; by trial on development seeds.
SUBPIXEL: Final = 16  # StereoSGBM returns sixteenths of a pixel, and searches a multiple of so many disparities
SCALE: Final = 2  # the prior is at half the resolution, because at a quarter the courses of a brick wall are one grey
FILL_PX: Final = 5  # Unknown pixels of the prior take the largest disparity so near, so that none is a hole.
MIN_DISPARITY_PX: Final = 0.5  # a smaller one is a point at infinity, within the noise; by trial on development seeds


class ColumnShift(NamedTuple):
    """Columns by which pixels are displaced in the upper panorama: the rig moved between the exposures."""

    at_infinity: Floats  # (H, W) px
    per_disparity: Floats  # (H, W) px/px


class SemiGlobalSearch:
    """SAD near a semi-global prior; keeps OpenCV's buffers. One thread may use it at a time."""

    def __init__(self, shape: tuple[int, int], disparities: int, window_px: int, max_cost: int) -> None:
        self._disparities, self._window_px, self._max_cost = disparities, window_px, max_cost
        self._searched = SUBPIXEL * max(1, -(-disparities // (SCALE * SUBPIXEL)))  # at the prior's resolution
        self._columns, self._rows = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in shape[::-1]))
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self._searched,
            blockSize=BLOCK_PX,
            P1=SMALL_STEP_PENALTY,
            P2=LARGE_STEP_PENALTY,
            disp12MaxDiff=LEFT_RIGHT_PX,
            preFilterCap=PREFILTER_CAP,
            uniquenessRatio=0,
            mode=cv2.STEREO_SGBM_MODE_SGBM,
        )

    def search(
        self, lower: Image, upper: Image, pixels: Indices, column_shift: ColumnShift | None
    ) -> tuple[Indices, Floats]:
        """Return the pixels with a prior and a minimum of the SAD near it, whose match lies in the image.

        With the warped panorama W(y) = upper(y + d(y)) of the prior d, a pixel whose SAD against W is least at the
        shift k has the disparity k + d(y + k).
        """
        # 1. The upper panorama, warped by the prior.
        height, width = lower.shape
        prior, known = self._prior(lower, upper)
        pixels, columns = pixels[known.reshape(-1)[pixels]], self._columns
        if column_shift is not None:
            columns = columns + column_shift.at_infinity + column_shift.per_disparity * prior
        warped = cv2.remap(upper, columns, self._rows + prior, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        padded = np.asarray(cv2.copyMakeBorder(warped, SCALE, SCALE, 0, 0, cv2.BORDER_REPLICATE), np.uint8)
        # 2. The SAD of the pixels at shifts up to one pixel of the prior, and its minimum.
        planes = (sad(lower, padded[k : k + height], self._window_px) for k in range(2 * SCALE + 1))
        costs = np.array([np.take(plane.reshape(-1), pixels, mode="clip") for plane in planes])
        is_minimum = local_minima(costs, self._max_cost)
        shift = subpixel(costs, np.where(is_minimum, costs, NO_MATCH).argmin(axis=0)) - SCALE
        # 3. The disparity, by the prior between the two nearest rows.
        row = pixels // width + shift
        above = np.clip(np.floor(row).astype(np.intp), 0, height - 2)
        before, after = (prior.reshape(-1)[(above + k) * width + pixels % width] for k in (0, 1))
        along = np.clip(row - above, 0, 1).astype(np.float32)
        disparity = np.asarray(shift + before + along * (after - before), np.float32)
        # 4. Those within the range and in the image.
        kept = is_minimum.any(axis=0) & (disparity > MIN_DISPARITY_PX) & (disparity < self._disparities)
        kept &= pixels // width + disparity < height
        return pixels[kept], disparity[kept]

    def _prior(self, lower: Image, upper: Image) -> tuple[Floats, Flags]:
        """Return disparities (H, W) float32 [px at full size], good to about a pixel, and flags of the known ones.

        An unknown pixel has the largest disparity of its known neighbours, or 0 where there are none.
        """
        found = self._matcher.compute(self._transposed_small(lower), self._transposed_small(upper))
        small = np.maximum(found[:, : self._searched - 1 : -1].T, 0)
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
        return np.ascontiguousarray(cv2.copyMakeBorder(small, 0, self._searched, 0, 0, cv2.BORDER_REPLICATE).T[:, ::-1])


def sad(lower: Image, upper: Image, window_px: int) -> Costs:
    """Return the SAD (H, W) of windows about the same pixels of two images; a window of up to 15 px fits 16 bits."""
    window, border = (window_px, window_px), cv2.BORDER_REPLICATE
    found = cv2.boxFilter(cv2.absdiff(lower, upper), cv2.CV_16U, window, normalize=False, borderType=border)
    return np.asarray(found, np.uint16)


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
