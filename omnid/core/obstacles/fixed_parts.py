"""Parts of panoramas that show what is fixed to a camera, such as the reflection of its lens in its mirror.

Such a part is at the same rows of both panoramas whatever the base does: floor that falls deep beside the base would
look so, too. A mask of the rig hides what was known when the rig was calibrated. What else there is shows as the base
turns: each heading shows another part of the world there, and what is fixed stays. With n headings whose normalised
textures (pair_views.py) have the mean m and the standard deviation s, a pixel is fixed where

    m sqrt(n) / s > T_0   and   m > m_0.

Headings count, and not places, as lines along a corridor stay where they are while a base drives through it. Only what
lies well below the horizon is judged: the horizon itself, and walls far away, are where they are at all headings, and
the rows next to them may be all that shows a bar as high as the cameras. A part without a border along columns, such
as an even strut, has m = 0: it shows nothing, and is no evidence by itself.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.obstacles.pair_views import COARSE_ROWS, CONTRAST_ROWS, DIRECTIONS, FOCAL_PX, TEXTURE_SHARE
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]
Texture = NDArray[np.int8]

HEADINGS: Final = 16  # of a full turn, 22 degrees apart, so that their textures have nothing in common
# Three quarters of a turn, because after fewer headings more of a cluttered place seems to be fixed (LEAST_RATIO). As
# many new views are taken before the next judgement.
LEAST_HEADINGS: Final = 12
# Least ratio of the mean and its standard error, because in a drive through clutter (872) 0.02 % of the pixels are
# above it after 12 headings, 0.08 % after 8, and borders of a lens have 10 to 60.
LEAST_RATIO: Final = 6.0
LEAST_MEAN: Final = 1.5  # sigmas of the noise, because weaker parts are no evidence of anything
LEAST_SIGMA: Final = 0.25  # of textures, because a black lens has none, by which no mean could be judged
UNITS: Final = 12.0  # levels of a texture in one sigma, because 8 bits hold ten sigmas either way
SPECK: Final = np.ones((2, 3), np.uint8)  # smallest part, because noise is narrower
# The band-pass shows the border of a part, so that what is between two of them belongs to it.
WITHIN: Final = np.ones((COARSE_ROWS, 9), np.uint8)
MOST: Final = 0.3  # Share that may be fixed, because where more is, images do not follow the heading.
LEAST_FALL: Final = math.tan(math.radians(20))  # Below the horizon, because floor there is within 2.5 m of a base.
# A base that moves by less turns on the spot, because it knows the floor beside it as at its start.
ON_THE_SPOT_M: Final = 0.2
LEAST_NEW: Final = 0.01  # share of the panorama that must be new, because it costs what was known about the floor


class FixedParts:
    """Learns fixed parts from pairs at known headings, and keeps those that it has found.

    Memory is bounded by HEADINGS pairs of small panoramas.
    """

    def __init__(self, cylinder: Cylinder) -> None:
        self._shape = cylinder.height, cylinder.width
        rows = max(1, round(cylinder.height * FOCAL_PX / cylinder.focal_px))
        self._size = max(1, DIRECTIONS * cylinder.width // cylinder.turn_px), rows
        self._first_row = round((cylinder.row0 + LEAST_FALL * cylinder.focal_px) * rows / cylinder.height)
        self._views: dict[int, Texture] = {}  # (2, rows, columns) of the lower and the upper panorama, by heading
        self._places_m: deque[Array] = deque(maxlen=LEAST_HEADINGS)  # (2,) of the newest views
        self._heading = -1  # of the pair before
        self._new = 0  # views since the last judgement
        self.pixels: Flags = np.zeros(self._shape, bool)  # (H, W) that are fixed in either panorama

    @property
    def share(self) -> float:
        """Return the share of the panorama that is fixed."""
        return float(self.pixels.mean())

    @property
    def headings(self) -> int:
        """Return the number of headings, of HEADINGS, that were seen."""
        return len(self._views)

    @property
    def is_on_the_spot(self) -> bool:
        """Return whether the newest views, of most of a turn, are of one place."""
        places_m = np.array(self._places_m)
        return len(places_m) == LEAST_HEADINGS and bool((np.ptp(places_m, axis=0) < ON_THE_SPOT_M).all())

    def observe(self, T_odom_base: Array, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags) -> bool:
        """Take a pair at a pose (4, 4) of the base; return True where it was judged what is fixed.

        visible (H, W): pixels that show the world as far as the rig knows, the same in all pairs.
        """
        # 1. One view of each heading, taken as the base turns to it.
        heading = int(float(se3.yaw(T_odom_base)) % math.tau / math.tau * HEADINGS) % HEADINGS
        if heading == self._heading:
            return False
        self._heading = heading
        shown = cv2.resize(visible.view(np.uint8), self._size, interpolation=cv2.INTER_AREA).astype(np.float32)
        self._views[heading] = np.stack([_texture(lower, shown), _texture(upper, shown)])
        self._places_m.append(T_odom_base[:2, 3].copy())
        self._new += 1
        # 2. Judged by all headings once as many are new as the least.
        if self._new < LEAST_HEADINGS or self.headings < LEAST_HEADINGS:
            return False
        self.judge()
        return True

    def judge(self) -> None:
        """Add to the fixed pixels what the views so far show."""
        self._new = 0
        found = self._judged()
        pixels = self.pixels | found
        if np.mean(found & ~self.pixels) >= LEAST_NEW and pixels.mean() <= MOST:
            self.pixels = pixels

    def _judged(self) -> Flags:
        """Return the pixels (H, W) that show the same at all headings."""
        count = self.headings
        total, squares = np.zeros((2, 2, *self._size[::-1]), np.float32)
        for view in self._views.values():
            texture = view.astype(np.float32) / np.float32(UNITS)
            total += texture
            squares += texture * texture
        mean = total / count
        variance = np.maximum((squares / count - mean * mean) * count / (count - 1), LEAST_SIGMA**2)
        same = (np.abs(mean) > LEAST_MEAN) & (mean * mean * count > LEAST_RATIO**2 * variance)
        pixels = np.asarray(same.any(axis=0)).view(np.uint8)
        pixels[: max(0, self._first_row)] = 0
        large = cv2.morphologyEx(pixels, cv2.MORPH_OPEN, SPECK)
        whole = cv2.morphologyEx(large, cv2.MORPH_CLOSE, WITHIN)
        return np.asarray(cv2.resize(whole, self._shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8) > 0


def _texture(panorama: PaddedPanorama, shown: Floats) -> Texture:
    """Return how much a panorama differs from its columns around, in units of what two views differ by.

    shown: 1 in pixels of the small panorama that show the world, 0 in others, which count in no mean.
    """
    image = np.ascontiguousarray(panorama.panorama)
    small = shown * cv2.resize(image, shown.shape[::-1], interpolation=cv2.INTER_AREA)
    around = cv2.blur(small, (1, COARSE_ROWS)) / np.maximum(cv2.blur(shown, (1, COARSE_ROWS)), 1e-3)
    band = small - shown * around
    contrast2 = cv2.blur(band * band, (3, CONTRAST_ROWS))
    texture = band / np.sqrt(panorama.noise_grey**2 + TEXTURE_SHARE**2 * contrast2)
    return np.asarray(np.clip(np.rint(UNITS * texture), -127, 127), np.int8)
