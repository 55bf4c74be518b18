"""What the ego-motion sees at one instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omnid.core.klt import Wrapped


@dataclass(frozen=True, slots=True)
class Sight:
    """Both panoramas, the disparity image (H, W) float32 [px] of the lower one (NaN unknown), and what is the world."""

    seq: int
    lower: Wrapped
    upper: Wrapped
    disparity: NDArray[np.float32]
    usable: NDArray[np.bool_]  # (H, W)
