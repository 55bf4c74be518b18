"""Semi-global matching at half resolution: a prior for the disparity of every pixel.

Where a texture repeats, the window of a pixel cannot distinguish its candidates. The path costs of Hirschmueller 2008
carry the answer from where it is unambiguous. OpenCV's StereoSGBM (8 paths) computes them on transposed panoramas; the
SAD at full resolution then searches near this prior only.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

BLOCK_PX = 3  # side of StereoSGBM's matching window at half resolution
SMALL_STEP_PENALTY = 50  # for a change of disparity by one: walls are smooth
LARGE_STEP_PENALTY = 3200  # for a larger change: depth edges are rare
LEFT_RIGHT_PX = 1  # largest disagreement of the disparities of both panoramas
PREFILTER_CAP = 31  # at which StereoSGBM cuts off the gradients it compares
SUBPIXEL = 16  # StereoSGBM returns sixteenths of a pixel
STEP_ROWS = 16  # StereoSGBM searches a multiple of so many disparities
SCALE = 2  # the prior is computed at half resolution


class SemiGlobalPrior:
    """Computes disparities of the lower panorama from half-size images; keeps OpenCV's buffers."""

    def __init__(self, disparities: int) -> None:
        self._rows = STEP_ROWS * max(1, -(-disparities // (SCALE * STEP_ROWS)))  # searched at half resolution
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=self._rows, blockSize=BLOCK_PX, P1=SMALL_STEP_PENALTY,
            P2=LARGE_STEP_PENALTY, disp12MaxDiff=LEFT_RIGHT_PX, preFilterCap=PREFILTER_CAP, uniquenessRatio=0,
            mode=cv2.STEREO_SGBM_MODE_HH)

    def disparity(self, lower: Image, upper: Image) -> Floats:
        """Return disparities (H, W) float32 [px at full size], good to about half a pixel; NaN where unknown."""
        found = self._matcher.compute(self._transposed_half(lower), self._transposed_half(upper))
        half = found[:, : self._rows - 1 : -1].T.astype(np.float32) * (SCALE / SUBPIXEL)
        half[half <= 0] = np.nan
        return np.asarray(cv2.resize(half, lower.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)

    def _transposed_half(self, panorama: Image) -> Image:
        """Return the panorama at half size, transposed and mirrored: its columns become rows, searched leftwards.

        StereoSGBM skips as many pixels at the start of a row as it searches; the repeated border fills them.
        """
        half = cv2.resize(panorama, None, fx=1 / SCALE, fy=1 / SCALE, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(cv2.copyMakeBorder(half, 0, self._rows, 0, 0, cv2.BORDER_REPLICATE).T[:, ::-1])
