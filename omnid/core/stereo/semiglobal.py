"""A disparity for every pixel that its neighbourhood supports: semi-global matching at half resolution.

Where a texture repeats, no window of a pixel tells its candidates apart; the path costs of Hirschmueller 2008 carry
the answer in from where it is plain. OpenCV's StereoSGBM (8 paths) does it on transposed panoramas in milliseconds; the
SAD at full resolution then only has to look around this prior.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

BLOCK_PX = 3
SMALL_STEP, LARGE_STEP = 50, 3200  # penalties for a change by one and by more: walls are smooth, edges are rare
LEFT_RIGHT_PX = 1
SUBPIXEL = 16  # StereoSGBM counts in sixteenths


class SemiGlobalPrior:
    """Disparities of the lower panorama from half-size images; keeps OpenCV's buffers."""

    def __init__(self, disparities: int) -> None:
        self._rows = 16 * max(1, -(-disparities // 32))  # half the disparities; StereoSGBM wants a multiple of 16
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=self._rows, blockSize=BLOCK_PX, P1=SMALL_STEP, P2=LARGE_STEP,
            disp12MaxDiff=LEFT_RIGHT_PX, preFilterCap=31, uniquenessRatio=0, mode=cv2.STEREO_SGBM_MODE_HH)

    def disparity(self, lower: Image, upper: Image) -> Floats:
        """Disparity (H, W) float32 [px of the full panorama], NaN where unknown; good to about half a pixel."""
        found = self._matcher.compute(self._half_on_its_side(lower), self._half_on_its_side(upper))
        half = found[:, : self._rows - 1 : -1].T.astype(np.float32) * (2 / SUBPIXEL)
        half[half <= 0] = np.nan
        return np.asarray(cv2.resize(half, lower.shape[::-1], interpolation=cv2.INTER_NEAREST), np.float32)

    def _half_on_its_side(self, panorama: Image) -> Image:
        """The panorama at half size, transposed and mirrored: its columns become rows, searched leftwards.

        StereoSGBM leaves out as many pixels at the start of a row as it searches; repeated border stands there.
        """
        half = cv2.resize(panorama, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(cv2.copyMakeBorder(half, 0, self._rows, 0, 0, cv2.BORDER_REPLICATE).T[:, ::-1])

