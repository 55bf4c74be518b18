"""Skew between the two cameras: its statistics, and the time between the exposures that follows from it."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

SKEW_GAIN: Final = 0.02  # weight of a new skew in the running mean: a memory of about 50 pairs
RECENT: Final = 30  # pairs to which a line is fitted
MIN_FITTED: Final = 8  # Of fewer pairs the median is taken.
JUMP_NS: Final = 5_000_000  # A larger distance from the line means a lost image, or a camera that was started again.
# Cameras that are triggered together have stamps that scatter about each other. Their mean difference is 0 unless it is
# larger than twice the scatter and than the least that stamps resolve.
SCATTERS: Final = 2.0
LEAST_NS, LEAST_AT_START_NS = 1_000_000, 3_000_000


class Skew:
    """Statistics of the skew, the upper camera's stamp minus the lower's, in ns."""

    def __init__(self) -> None:
        self.mean_ns = math.nan  # running mean
        self.max_ns = 0  # largest absolute value
        self._settled_ns = math.nan  # running mean once it has averaged over its whole memory
        self._pairs = 0
        self._recent: deque[int] = deque(maxlen=RECENT)
        self.exposure_ns = 0.0  # upper minus lower exposure of the newest pair

    def add(self, skew_ns: int) -> None:
        """Add the skew of a pair."""
        self._pairs += 1
        gain = max(SKEW_GAIN, 1 / self._pairs)
        self.mean_ns = skew_ns if self._pairs == 1 else self.mean_ns + gain * (skew_ns - self.mean_ns)
        self.max_ns = max(self.max_ns, abs(skew_ns))
        if self._pairs == round(1 / SKEW_GAIN):
            self._settled_ns = self.mean_ns
        self.exposure_ns = self._between_exposures(skew_ns)

    @property
    def drift_ns(self) -> float:
        """Change of the running mean since it had settled; NaN before."""
        return self.mean_ns - self._settled_ns

    def _between_exposures(self, skew_ns: int) -> float:
        """Return the skew without the scatter of the stamps; 0 where the exposures may be simultaneous.

        Free-running cameras drift against each other, so a line is fitted to the recent skews.
        """
        recent = self._recent
        if recent and abs(skew_ns - recent[-1]) > JUMP_NS:
            recent.clear()
        recent.append(skew_ns)
        if len(recent) < MIN_FITTED:
            median = float(np.median(recent))
            return median if abs(median) > LEAST_AT_START_NS else 0.0
        # Least squares in closed form: sums of whole numbers are exact.
        count, total, moment = len(recent), sum(recent), sum(index * each for index, each in enumerate(recent))
        indices, squares = count * (count - 1) // 2, count * (count - 1) * (2 * count - 1) // 6
        slope = (count * moment - indices * total) / (count * squares - indices**2)
        start = (total - slope * indices) / count
        newest = start + slope * (count - 1)
        squared = sum((each - start - slope * index) ** 2 for index, each in enumerate(recent))
        return newest if abs(newest) > max(SCATTERS * math.sqrt(squared / (count - 2)), LEAST_NS) else 0.0
