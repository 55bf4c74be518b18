"""Frames of both cameras as grey images of the size of their rig; what cannot be used is counted."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.frame import Camera, Frame
from omnid.errors import OmnidError
from omnid.simulation.rendering.rigs import make_rig
from omnid.stages.synchronise import Decoder

SIDE_PX = 64
IMAGE = np.arange(SIDE_PX**2, dtype=np.uint8).reshape(SIDE_PX, SIDE_PX).tobytes()


def frame(camera: Camera = "lower", side_px: int = SIDE_PX, data: bytes = IMAGE) -> Frame:
    return Frame(3, 7, camera, "mono8", data, side_px, side_px)


def test_images_are_decoded() -> None:
    decode = Decoder(make_rig(size=SIDE_PX))
    lower, upper = decode(frame("lower")), decode(frame("upper", data=bytes(IMAGE[::-1])))
    assert lower is not None and lower.tobytes() == IMAGE
    assert upper is not None and upper.tobytes() == IMAGE[::-1]


def test_damaged_frames_are_counted_with_the_first_reason() -> None:
    decode = Decoder(make_rig(size=SIDE_PX))
    assert decode(frame(data=b"short")) is None and decode(frame("upper", data=b"")) is None
    assert decode.broken == 2 and "5 bytes" in decode.fault


def test_the_first_image_must_have_the_size_of_the_rig_and_later_ones_are_left_out() -> None:
    decode, half = Decoder(make_rig(size=SIDE_PX)), SIDE_PX // 2
    small = frame(side_px=half, data=IMAGE[: half**2])
    with pytest.raises(OmnidError, match="lower camera's images are 32x32 px, the rig's are 64x64 px"):
        decode(small)
    assert decode(frame()) is not None and decode(small) is None
    assert decode.fault == "lower frame 3 is 32x32 px, unlike those before"
