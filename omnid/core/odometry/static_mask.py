"""Detection of structure that is fixed to the rig: struts, hub, rim, the robot itself.

Such structure must not be used as a feature. It keeps its place in the panorama in many comparisons between which the
view of the world should have moved by many pixels.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

# Columns are compared only if the world should have moved by this angle, and by these pixels at half resolution: in a
# small panorama the angle is one pixel, by which most of a view hardly changes.
MIN_FLOW_RAD, MIN_FLOW_PX = 0.04, 2.0
MOVED_RATIO = 0.5  # share of the columns that moved before a comparison is made.
USUAL_RANGE_M = 3.0  # range at which a translation is converted to an angle.
# Grey levels: largest difference that counts as unchanged. Measured: with 0.67 and 1.5 times as much the odometry errs
# by 1.00 to 1.06 times as much.
SAME_LEVEL = 6
MIN_CONTRAST = 25  # grey levels within REACH_PX, because without contrast nothing can be seen to keep its place
REACH_PX = 4  # at half resolution.
EVIDENCE = 5  # Number of comparisons, each of another view, after which a pixel is fixed: chance repeats none in all.
MAX_EVIDENCE = 4 * EVIDENCE  # Limit, so that a pixel that was fixed by mistake is released after a few changes.


class StaticMask:
    """Learns, at half resolution, where structure stays the same while the robot moves."""

    def __init__(self, azimuths_rad: tuple[float, float] = (math.pi, -math.pi)) -> None:
        """azimuths_rad: of the left and of the right edge of the panoramas."""
        self._edges_rad = azimuths_rad
        self._reference: tuple[Image, Flags, Array] | None = None  # panorama at half resolution, structure, pose
        self._streak: NDArray[np.uint8] | None = None
        self._free: Flags | None = None  # (H, W) None: nothing is known to be fixed

    def observe(self, panorama: Image, T_odom_rect: Array) -> None:
        """Compare the panorama (H, W) at an accepted pose with the last one, once the view should have moved."""
        if self._reference is None:
            half = _half(panorama)
            self._reference = (half, _structured(half), T_odom_rect)
            return
        columns = self._reference[0].shape[1]
        flow = expected_flow(se3.inverse(self._reference[2]) @ T_odom_rect, columns, self._edges_rad)
        moving = flow > max(MIN_FLOW_RAD, MIN_FLOW_PX * (self._edges_rad[0] - self._edges_rad[1]) / columns)
        if np.mean(moving) > MOVED_RATIO:
            half = _half(panorama)
            structured = _structured(half)
            self._compare(half, structured, moving, panorama.shape)
            self._reference = (half, structured, T_odom_rect)

    def without(self, usable: Flags) -> Flags:
        """Return usable (H, W) without what is known to be fixed, and a margin around it."""
        return usable if self._free is None else usable & self._free

    def _compare(self, half: Image, structured: Flags, moving: Flags, shape: tuple[int, ...]) -> None:
        """Count one comparison; columns (W/2,) that should not have moved keep their evidence."""
        assert self._reference is not None
        before, structured_before, _ = self._reference
        same = (cv2.absdiff(half, before) <= SAME_LEVEL) & structured & structured_before
        streak = np.zeros(half.shape, np.uint8) if self._streak is None else self._streak
        # One change halves the evidence: the world loses it as soon as another object comes into view.
        counted = np.where(same, np.minimum(streak + np.uint8(1), np.uint8(MAX_EVIDENCE)), streak >> 1)
        self._streak = np.where(moving, counted, streak)
        margin = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
        fixed = cv2.dilate((self._streak >= EVIDENCE).view(np.uint8), margin)
        # Usually nothing is fixed: then no mask of the whole size is made and applied.
        self._free = None
        if fixed.any():
            free = cv2.resize(1 - fixed, shape[::-1], interpolation=cv2.INTER_NEAREST)
            self._free = np.asarray(free, np.uint8).view(bool)


def expected_flow(T_before_after: Array, columns: int, edges_rad: tuple[float, float]) -> Array:
    """Return about how far [rad] each of `columns` of a panorama should have moved, by rotation and by translation.

    edges_rad: azimuths of its left and right edge.
    """
    twist = se3.log(T_before_after)
    azimuth = edges_rad[0] - (np.arange(columns) + 0.5) * (edges_rad[0] - edges_rad[1]) / columns
    across = np.abs(twist[1] * np.cos(azimuth) - twist[0] * np.sin(azimuth))
    return np.asarray(abs(twist[5]) + across / USUAL_RANGE_M)


def _half(panorama: Image) -> Image:
    """Return the panorama at half resolution, so that noise and half a pixel of shift do not count."""
    return np.asarray(cv2.resize(panorama, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


def _structured(half: Image) -> Flags:
    """Return flags of the pixels with contrast within REACH_PX."""
    around = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    return np.asarray(cv2.morphologyEx(half, cv2.MORPH_GRADIENT, around) > MIN_CONTRAST)
