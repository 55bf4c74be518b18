"""Compression of images for the viewer."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.frame import gray
from drivers.logs.ros_image import RosImage

COMPRESSED: Final = ("jpeg", "png")
QUALITY: Final = 85


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """Encode an image (H, W) as JPEG."""
    return cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))[1].tobytes()


def compressed(image: RosImage) -> tuple[bytes, str]:
    """Return compressed bytes and their kind; raw images become grey JPEG. Raise FrameDecodeError where damaged."""
    if image.encoding in COMPRESSED:
        return bytes(image.data), image.encoding
    return jpeg(gray(image.frame())), "jpeg"
