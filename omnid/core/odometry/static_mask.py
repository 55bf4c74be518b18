"""Detection of structure that is fixed to the rig: struts, hub, rim, the robot itself.

Such structure must not be used as a feature. It keeps its place in the panorama in many comparisons between which the
view of the world should have moved by many pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.odometry.estimates import ROOM_M

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]

# Columns are compared only if the world should have moved by this angle, and by these pixels at half resolution: in a
# small panorama the angle is one pixel, by which most of a view hardly changes.
MIN_FLOW_RAD, MIN_FLOW_PX = 0.04, 2.0
# Grey levels: largest difference that counts as unchanged. Measured: with 0.67 and 1.5 times as much the odometry errs
# by 1.00 to 1.06 times as much.
SAME_LEVEL = 6
MIN_CONTRAST = 25  # grey levels within REACH_PX, because without contrast nothing can be seen to keep its place
REACH_PX = 4  # at half resolution.
EVIDENCE = 5  # comparisons, each of another view, after which a pixel is fixed: chance repeats none in all


class StaticMask:
    """Learns, at half resolution, where structure stays the same while the robot moves."""

    def __init__(self, cylinder: Cylinder) -> None:
        self._cylinder = cylinder
        self._reference: tuple[Image, Array] | None = None  # panorama at half resolution, pose
        self._streak: NDArray[np.uint8] | None = None
        self._free: Flags | None = None  # (H, W) None: nothing is known to be fixed

    def observe(self, panorama: Image, T_odom_rect: Array) -> None:
        """Compare the panorama (H, W) at an accepted pose with the last one, once the view should have moved."""
        # 1. About how far each column should have moved since, by rotation and by translation.
        if self._reference is not None:
            before, T_before = self._reference
            twist = se3.log(se3.inverse(T_before) @ T_odom_rect)
            columns: Array = 2.0 * np.arange(before.shape[1], dtype=float) + 0.5
            azimuth = self._cylinder.azimuth(columns)
            across = np.abs(twist[1] * np.cos(azimuth) - twist[0] * np.sin(azimuth))
            flow_rad = abs(twist[5]) + across / ROOM_M
            moving = flow_rad > max(MIN_FLOW_RAD, 2 * MIN_FLOW_PX / self._cylinder.focal_px)
            if np.mean(moving) <= 0.5:
                return
        # 2. Noise and half a pixel of shift do not count at half resolution.
        half = np.asarray(cv2.resize(panorama, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        window = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
        if self._reference is not None:
            # 3. One change halves the evidence: the world loses it as soon as another object comes into view.
            same = cv2.absdiff(half, before) <= SAME_LEVEL
            for image in (half, before):
                same &= cv2.morphologyEx(image, cv2.MORPH_GRADIENT, window) > MIN_CONTRAST
            streak = np.zeros(half.shape, np.uint8) if self._streak is None else self._streak
            counted = np.where(same, np.minimum(streak + np.uint8(1), np.uint8(4 * EVIDENCE)), streak >> 1)
            self._streak = np.where(moving, counted, streak)
            # 4. What is fixed, with a margin. Usually nothing is: then no mask of the whole size is made and applied.
            fixed = cv2.dilate((self._streak >= EVIDENCE).view(np.uint8), window)
            free = cv2.resize(1 - fixed, panorama.shape[::-1], interpolation=cv2.INTER_NEAREST)
            self._free = np.asarray(free, np.uint8).view(bool) if fixed.any() else None
        self._reference = half, T_odom_rect

    def without(self, usable: Flags) -> Flags:
        """Return usable (H, W) without what is known to be fixed, and a margin around it."""
        return usable if self._free is None else usable & self._free
