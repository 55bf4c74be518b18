"""What turns with the camera: struts, hub, rim, the robot itself. It must never count as a feature.

Structure that keeps its place in the panorama while everything about it should have moved by many pixels, again and
again, belongs to the rig and not to the world.
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

LEAST_FLOW_RAD = 0.04  # what must have moved less than this says nothing
USUAL_RANGE_M = 3.0  # at which a shift is turned into an angle
SAME_LEVEL = 6  # grey levels
CONTRAST = 25  # grey levels within REACH_PX, without which there is no structure to hold its place
REACH_PX = 4  # at half resolution
EVIDENCE = 5  # comparisons running


class StaticMask:
    """Learns, at half resolution, where structure stays the same while the robot moves."""

    def __init__(self) -> None:
        self._reference: tuple[Image, Array] | None = None
        self._streak: NDArray[np.uint8] | None = None
        self._blocked: Flags | None = None

    def observe(self, panorama: Image, T_odom_rect: Array) -> None:
        """Takes the panorama (H, W) at a trusted pose; compares it once the view has moved since the last time."""
        if self._reference is None:
            self._reference = (_half(panorama), T_odom_rect)
            return
        flow = expected_flow(se3.inverse(self._reference[1]) @ T_odom_rect, self._reference[0].shape[1])
        if np.mean(flow > LEAST_FLOW_RAD) > 0.5:
            half = _half(panorama)
            self._compare(half, flow > LEAST_FLOW_RAD, panorama.shape)
            self._reference = (half, T_odom_rect)

    def without(self, usable: Flags) -> Flags:
        """usable (H, W) less what is known to be fixed, and a margin about it."""
        return usable if self._blocked is None else usable & ~self._blocked

    def _compare(self, half: Image, moving: Flags, shape: tuple[int, ...]) -> None:
        """Counts one comparison; columns (W/2,) that should not have moved keep what is known of them."""
        assert self._reference is not None
        before = self._reference[0]
        same = (cv2.absdiff(half, before) <= SAME_LEVEL) & _structured(half) & _structured(before)
        streak = np.zeros(half.shape, np.uint8) if self._streak is None else self._streak
        # One change halves the evidence: the world loses it as soon as something else comes into view.
        counted = np.where(same, np.minimum(streak + 1, 4 * EVIDENCE), streak // 2).astype(np.uint8)
        self._streak = np.where(moving, counted, streak)
        fixed = (self._streak >= EVIDENCE).astype(np.uint8)
        fixed = np.asarray(cv2.resize(fixed, shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)
        margin = np.ones((4 * REACH_PX + 1, 4 * REACH_PX + 1), np.uint8)
        self._blocked = np.asarray(cv2.dilate(fixed, margin) > 0)


def expected_flow(T_before_after: Array, columns: int) -> Array:
    """About how far [rad] each of `columns` of a panorama should have moved: by turn, and by shift across it."""
    twist = se3.log(T_before_after)
    azimuth = math.pi - (np.arange(columns) + 0.5) * 2 * math.pi / columns
    across = np.abs(twist[1] * np.cos(azimuth) - twist[0] * np.sin(azimuth))
    return np.asarray(abs(twist[5]) + across / USUAL_RANGE_M)


def _half(panorama: Image) -> Image:
    """The panorama at half resolution, so that noise and half a pixel of shift do not count."""
    return np.asarray(cv2.resize(panorama, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


def _structured(half: Image) -> Flags:
    """Where there is contrast close by."""
    around = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    return np.asarray(cv2.morphologyEx(half, cv2.MORPH_GRADIENT, around) > CONTRAST)
