"""Brightness of the floor as the lower camera sees it, at places around the base."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Greys = NDArray[np.float32]
Flags = NDArray[np.bool_]

SMOOTH_PX: Final = 5  # side of the square whose mean is taken: some 5 cm of the floor at 1.5 m


class FloorView(NamedTuple):
    """Floor of one panorama at places (N, 2)."""

    grey: Greys  # (N,) mean brightness around the place
    in_view: Flags  # (N,) the camera sees the place, unless something stands before it
    noise_grey: float = 1.0  # of a pixel


class FloorCamera:
    """Looks up places of the floor in lower panoramas."""

    def __init__(self, cylinder: Cylinder, T_rect_floor: Array) -> None:
        """T_rect_floor (4, 4): from the level frame of the base, with the floor at z = 0, to the rectified frame."""
        self._cylinder, self._T_rect_floor = cylinder, T_rect_floor

    def view(self, panorama: PaddedPanorama, visible: Flags, places: Array) -> FloorView:
        """Return the brightness at places (N, 2) [m] of the level frame; visible (H, W): pixels that show the world."""
        points = se3.apply(self._T_rect_floor, np.column_stack([places, np.zeros(len(places))]))
        pixels = self._cylinder.pixels(points).astype(np.float32)
        columns, rows = np.rint(pixels).astype(np.intp).T
        inside = (rows >= 0) & (rows < self._cylinder.height)
        in_view = inside & visible[np.where(inside, rows, 0), columns % self._cylinder.width]
        if not in_view.any():
            return FloorView(np.full(len(places), np.nan, np.float32), in_view, panorama.noise_grey)
        top = max(0, int(rows[in_view].min()) - SMOOTH_PX)
        smooth = cv2.blur(panorama.image[top:], (SMOOTH_PX, SMOOTH_PX))
        # cv2.remap takes at most 32767 places in a row.
        size = math.isqrt(len(places)) + 1
        x, y = (np.resize(pixels[:, i] + np.float32(by), (size, size)) for i, by in enumerate((panorama.pad_px, -top)))
        grey = cv2.remap(smooth.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        grey = grey.ravel()[: len(places)]
        return FloorView(np.where(in_view, grey, np.nan).astype(np.float32), in_view, panorama.noise_grey)
