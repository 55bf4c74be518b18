"""Memory of what the floor looks like in the cells of a square: where it looks otherwise, something hides it.

Stereo needs edges; brightness does not. A plain person shows stereo nothing, and hides all the floor behind; a patch of
floor without edges shows stereo nothing either, and looks as before. The panoramas are compared after one gain for all
cells (exposures change); their noise is averaged over cells.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Greys = NDArray[np.float32]
Flags = NDArray[np.bool_]

CHANGE_PER_NOISE: Final = 1.0  # least mean difference over SMOOTH_CELLS^2 cells, where the panorama has so much noise
FAINTEST_GREY: Final = 30.0  # a difference that must be told: with more noise, nothing can be compared
SMOOTH_CELLS: Final = 3
LEARNING: Final = 0.3  # share of the newest view in what is remembered
LEAST_CELLS: Final = 50  # that tell the gain
LEAST_GAIN: Final = 0.1


class FloorMemory:
    """Brightness (CELLS, CELLS) of the cells of a square, NaN unknown, and which of them look otherwise now."""

    def __init__(self, cells: int, change_grey: float) -> None:
        """change_grey: least mean difference over SMOOTH_CELLS^2 cells that is a change; 0: nothing is compared."""
        self._change_grey = change_grey
        self.grey: Greys = np.full((cells, cells), np.nan, np.float32)
        self.changed: Flags = np.zeros((cells, cells), bool)
        self._gain = 1.0  # of the newest panorama, against what is remembered

    def compare(self, window: tuple[slice, slice], grey: Greys, noise_grey: float) -> Flags:
        """Mark the cells of a window that changed; return those (rows, columns) that look as before.

        grey: brightness of the window's cells now, NaN where it is not seen; noise_grey: of a pixel.
        """
        before, changed = self.grey[window], self.changed[window]
        both = np.isfinite(grey) & np.isfinite(before)
        steady = both & ~changed
        if steady.sum() < LEAST_CELLS:
            steady = both
        if steady.sum() < LEAST_CELLS:
            return np.zeros_like(both)
        self._gain = gain = max(float(np.median(grey[steady] / np.maximum(before[steady], 1.0))), LEAST_GAIN)
        limit = max(self._change_grey, CHANGE_PER_NOISE * noise_grey / gain)
        if CHANGE_PER_NOISE * noise_grey / gain > FAINTEST_GREY or not self._change_grey:
            return np.zeros_like(both)
        difference = np.where(both, grey / np.float32(gain) - before, np.float32(0.0))
        size = (SMOOTH_CELLS, SMOOTH_CELLS)
        weight = cv2.blur(both.astype(np.float32), size)
        mean = cv2.blur(difference.astype(np.float32), size) / np.maximum(weight, np.float32(1e-3))
        differs = np.abs(mean) > limit
        changed[both] = differs[both]
        same = both & ~differs
        before[same] += LEARNING * difference[same]
        return np.asarray(same)

    def learn(self, window: tuple[slice, slice], grey: Greys, cells: Flags) -> None:
        """Begin to remember cells (rows, columns) of a window, where their brightness is not known yet."""
        new = cells & np.isfinite(grey) & np.isnan(self.grey[window])
        self.grey[window][new] = grey[new] / self._gain

    def forget(self, cells: Flags) -> None:
        """Forget cells (CELLS, CELLS)."""
        self.grey[cells] = np.nan
        self.changed[cells] = False
