"""What turns with the camera: struts, hub, rim, the robot itself. It must never count as a feature.

A pixel that keeps its grey level while the view around it has moved by many pixels, again and again, belongs to the
rig and not to the world.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]


class FixedPattern:
    """Learns, at half resolution, which pixels stay the same while the robot moves."""

    def __init__(self, least_motion: float = 0.08, same_level: int = 6, evidence: int = 6, margin_px: int = 9) -> None:
        self._least_motion, self._same_level = least_motion, same_level
        self._evidence, self._margin_px = evidence, margin_px
        self._reference: tuple[Image, Array] | None = None
        self._streak: NDArray[np.uint8] | None = None
        self._blocked: Flags | None = None

    def observe(self, panorama: Image, T_odom_rect: Array) -> None:
        """Takes the panorama (H, W) at a trusted pose; compares it once the view has moved since the last time."""
        if self._reference is None:
            self._reference = (_half(panorama), T_odom_rect)
        elif _motion(se3.inverse(self._reference[1]) @ T_odom_rect) > self._least_motion:
            self._compare(_half(panorama), panorama.shape)
            self._reference = (_half(panorama), T_odom_rect)

    def without(self, usable: Flags) -> Flags:
        """usable (H, W) less what is known to be fixed, and a margin about it."""
        return usable if self._blocked is None else usable & ~self._blocked

    def _compare(self, half: Image, shape: tuple[int, ...]) -> None:
        assert self._reference is not None
        same = cv2.absdiff(half, self._reference[0]) <= self._same_level
        streak = np.zeros(half.shape, np.uint8) if self._streak is None else self._streak
        # One change halves the evidence: a plain wall loses it as soon as something else comes into view.
        self._streak = np.where(same, np.minimum(streak + 1, 4 * self._evidence), streak // 2).astype(np.uint8)
        fixed = cv2.resize((self._streak >= self._evidence).astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST)
        side = 2 * self._margin_px + 1
        self._blocked = cv2.dilate(fixed, np.ones((side, side), np.uint8)) > 0


def _half(panorama: Image) -> Image:
    """The panorama at half resolution, so that noise and half a pixel of shift do not count."""
    return np.asarray(cv2.resize(panorama, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


def _motion(T: Array) -> float:
    """About how far [rad] the view has moved: the turn, and the shift as seen two metres away."""
    twist = se3.log(T)
    return float(np.linalg.norm(twist[3:]) + np.linalg.norm(twist[:3]) / 2)
