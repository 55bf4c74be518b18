"""What is fixed to a camera, by pairs of a robot that turns, such as the reflection of its lens in its mirror.

Such a part is at the same rows of both panoramas whatever the base does: floor that falls deep beside the base would
look so, too. As the base turns each heading shows another part of the world there, and what is fixed stays. With n
headings whose normalised textures (core/obstacles/panoramas.py) have the mean m and the standard deviation s, a pixel
is fixed where

    m sqrt(n) / s > T_0   and   m > m_0.

Headings count, and not places, as lines along a corridor stay where they are while a base drives through it. Only what
lies well below the horizon is judged: the horizon itself, and walls far away, are where they are at all headings. A
part without a border along columns, such as an even strut, has m = 0: it shows nothing, and is no evidence by itself.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.obstacles.panoramas import AROUND_ROWS, DIRECTIONS, FOCAL_PX, TEXTURE_SHARE
from omnid.core.types.panorama import PaddedPanorama

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

HEADINGS: Final = 16  # of a full turn, 22 degrees apart, so that their textures have nothing in common
# Three quarters of a turn, because after fewer headings more of a cluttered place seems to be fixed (LEAST_RATIO).
LEAST_HEADINGS: Final = 12
# Least ratio of the mean and its standard error, because in a drive through clutter (872) 0.02 % of the pixels are
# above it after 12 headings, 0.08 % after 8, and borders of a lens have 10 to 60.
LEAST_RATIO: Final = 6.0
LEAST_MEAN: Final = 1.5  # sigmas of the noise, because weaker parts are no evidence of anything
LEAST_SIGMA: Final = 0.25  # of textures, because a black lens has none, by which no mean could be judged
SPECK: Final = np.ones((2, 3), np.uint8)  # smallest part, because noise is narrower
# The band-pass shows the border of a part, so that what is between two of them belongs to it.
BETWEEN: Final = np.ones((AROUND_ROWS, 9), np.uint8)
# Shares of the panorama that may be fixed, because less is noise, and where more is images do not follow the heading.
LEAST, MOST = 0.01, 0.3
LEAST_FALL: Final = math.tan(math.radians(20))  # below the horizon, because floor there is within 2.5 m of a base


class FixedParts:
    """What is fixed to the cameras, by one pair of each heading."""

    def __init__(self, cylinder: Cylinder) -> None:
        self._shape = cylinder.height, cylinder.width
        rows = max(1, round(cylinder.height * FOCAL_PX / cylinder.focal_px))
        self._size = max(1, DIRECTIONS * cylinder.width // cylinder.turn_px), rows
        self._first_row = round((cylinder.row0 + LEAST_FALL * cylinder.focal_px) * rows / cylinder.height)
        self._views: dict[int, Floats] = {}  # (2, rows, columns) of the lower and the upper panorama, by heading
        self._heading = -1  # of the pair before

    @property
    def headings(self) -> int:
        """Return the number of headings, of HEADINGS, that were seen."""
        return len(self._views)

    def observe(self, T_odom_base: Array, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags) -> None:
        """Take a pair at a pose (4, 4) of the base, the first one of each turn to a heading.

        visible (H, W): pixels that show the world as far as the rig knows, the same in all pairs.
        """
        heading = int(float(se3.yaw(T_odom_base)) % math.tau / math.tau * HEADINGS) % HEADINGS
        if heading != self._heading:
            self._heading = heading
            shown = cv2.resize(visible.view(np.uint8), self._size, interpolation=cv2.INTER_AREA).astype(np.float32)
            self._views[heading] = np.stack([_texture(lower, shown), _texture(upper, shown)])

    def pixels(self) -> Flags:
        """Return the pixels (H, W) that show the same at all headings in either panorama."""
        views = np.stack(list(self._views.values()))
        mean, variance = views.mean(axis=0), np.maximum(views.var(axis=0, ddof=1), LEAST_SIGMA**2)
        same = (np.abs(mean) > LEAST_MEAN) & (mean * mean * len(views) > LEAST_RATIO**2 * variance)
        found = same.any(axis=0).view(np.uint8)
        found[: max(0, self._first_row)] = 0
        whole = cv2.morphologyEx(cv2.morphologyEx(found, cv2.MORPH_OPEN, SPECK), cv2.MORPH_CLOSE, BETWEEN)
        pixels = np.asarray(cv2.resize(whole, self._shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8) > 0
        return pixels if LEAST <= pixels.mean() <= MOST else np.zeros(self._shape, bool)


def _texture(panorama: PaddedPanorama, shown: Floats) -> Floats:
    """Return how much a panorama differs from its columns around, in units of what two views differ by.

    shown: 1 in pixels of the small panorama that show the world, 0 in others, which count in no mean.
    """
    image = np.ascontiguousarray(panorama.panorama)
    small = shown * cv2.resize(image, shown.shape[::-1], interpolation=cv2.INTER_AREA)
    around = cv2.blur(small, (1, AROUND_ROWS)) / np.maximum(cv2.blur(shown, (1, AROUND_ROWS)), 1e-3)
    band = small - shown * around
    contrast2 = cv2.blur(band * band, (3, AROUND_ROWS))
    return np.asarray(band / np.sqrt(panorama.noise_grey**2 + TEXTURE_SHARE**2 * contrast2), np.float32)
