"""Images as the bytes of a PNG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image (H, W) or (H, W, 3) uint8 as the bytes of a PNG."""
    return cv2.imencode(".png", image)[1].tobytes()
