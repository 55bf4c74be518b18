"""Recognise images that a camera delivers again with new stamps: its sensor, its driver or its host is frozen."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

KEPT: Final = 4  # earlier images compared with: a driver that is stuck may hand out its buffers in turn
SAMPLED_PX: Final = 16  # rows and columns of the first comparison: the noise of any real image differs there
FROZEN_IMAGES: Final = 5  # repeated images in a row after which a camera counts as frozen: a single one may be a glitch


class RepeatedImages:
    """Compare the images of one camera with the KEPT ones before; all pixels must be equal.

    An image repeats if it equals the one before, or if the last images equal those a period of up to KEPT images
    earlier, all of that period. A log that is played forwards and backwards repeats one image at each end only.
    """

    def __init__(self) -> None:
        self._earlier: deque[tuple[bytes, Image]] = deque(maxlen=KEPT)  # with samples of them, the newest first
        self._equal = [0] * KEPT  # consecutive images that equal the one 1, 2 ... KEPT images earlier
        self.count = 0  # repeated images in all
        self.longest = 0  # most of them in a row
        self._in_a_row = 0

    @property
    def frozen(self) -> bool:
        """True if the newest images are repeated ones."""
        return self._in_a_row >= FROZEN_IMAGES

    def add(self, image: Image) -> bool:
        """Take the next image (H, W); return True if it repeats earlier ones."""
        sample = image[::SAMPLED_PX, ::SAMPLED_PX].tobytes()  # decides at once for images that are not equal
        for index, (earlier_sample, earlier) in enumerate(self._earlier):
            is_equal = sample == earlier_sample and np.array_equal(image, earlier)
            self._equal[index] = self._equal[index] + 1 if is_equal else 0
        self._earlier.appendleft((sample, image))
        repeated = any(count > index for index, count in enumerate(self._equal))
        self.count += repeated
        self._in_a_row = self._in_a_row + 1 if repeated else 0
        self.longest = max(self.longest, self._in_a_row)
        return repeated
