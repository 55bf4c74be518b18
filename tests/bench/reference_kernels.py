"""Reference kernels: one StereoSGBM and one Lucas-Kanade call on a pair of panoramas.

Their processor time says how fast a machine is at the time of a measurement; a virtual machine changes by a factor of
two within a day. Figures of other days and machines compare as ratios to it.
"""

from __future__ import annotations

import time
from functools import cache
from statistics import median
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

SGBM_DISPARITIES, SGBM_BLOCK_PX = 128, 5
LK_CORNERS, LK_WINDOW_PX, LK_LEVELS = 500, 15, 3
LK_QUALITY, LK_APART_PX = 0.001, 8
LUCAS_KANADE: Final = cv2.calcOpticalFlowPyrLK  # not the one that is timed as a step
SIZE_PX: Final = (384, 1304)  # rows and columns of the panoramas of cameras of 768 px
SHIFT_PX, MOTION_PX = 12, 5  # disparity, and motion from image to image
RUNS: Final = 7
Image = NDArray[np.uint8]


class ReferenceKernels:
    """The two kernels with their settings."""

    def __init__(self) -> None:
        self._sgbm = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=SGBM_DISPARITIES,
            blockSize=SGBM_BLOCK_PX,
            P1=8 * SGBM_BLOCK_PX**2,
            P2=32 * SGBM_BLOCK_PX**2,
            mode=cv2.STEREO_SGBM_MODE_SGBM,
        )

    def sgbm_ns(self, lower: Image, upper: Image) -> int:
        """Return the processor time [ns] of the disparity of two panoramas (H, W)."""
        turned = [np.ascontiguousarray(image.T[:, ::-1]) for image in (lower, upper)]
        start_ns = time.thread_time_ns()
        self._sgbm.compute(*turned)
        return time.thread_time_ns() - start_ns

    def lucas_kanade_ns(self, before: Image, now: Image) -> int:
        """Return the processor time [ns] of tracking LK_CORNERS corners from one panorama (H, W) to the next."""
        corners = cv2.goodFeaturesToTrack(before, LK_CORNERS, LK_QUALITY, LK_APART_PX)
        start_ns = time.thread_time_ns()
        LUCAS_KANADE(before, now, corners, None, winSize=(LK_WINDOW_PX, LK_WINDOW_PX), maxLevel=LK_LEVELS)
        return time.thread_time_ns() - start_ns


@cache
def reference_ms() -> float:
    """Return the processor time [ms] of both kernels on drawn panoramas; the median of RUNS, in one thread."""
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.integers(0, 255, SIZE_PX, dtype=np.uint8), (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    upper, later = np.roll(texture, SHIFT_PX, axis=0), np.roll(texture, MOTION_PX, axis=1)
    kernels, threads = ReferenceKernels(), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        spent = [kernels.sgbm_ns(texture, upper) + kernels.lucas_kanade_ns(texture, later) for _ in range(RUNS)]
    finally:
        cv2.setNumThreads(threads)
    return median(spent) * 1e-6
