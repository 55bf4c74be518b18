"""Images for the viewer: compressed ones as they are, raw ones as grey JPEG."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.ros_image import RosImage
from omnid.viewer.image_encoding import compressed

GREY = np.tile(np.arange(0, 240, 10, dtype=np.uint8), (16, 1))


@pytest.mark.parametrize("encoding", ["jpeg", "png"])
def test_compressed_images_stay_as_they_are(encoding: str) -> None:
    assert compressed(RosImage(1, encoding, memoryview(b"bytes"))) == (b"bytes", encoding)


def test_raw_images_become_grey_jpeg() -> None:
    data, encoding = compressed(RosImage(1, "mono8", memoryview(GREY.tobytes()), 24, 16, 24))
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert encoding == "jpeg" and shown.shape == GREY.shape and np.abs(shown.astype(int) - GREY).max() < 8


def test_damaged_images_are_an_error() -> None:
    with pytest.raises(FrameDecodeError):
        compressed(RosImage(1, "mono8", memoryview(b"x"), 24, 16, 24))
