"""Images in the bytes of ROS messages: of any writer, and damaged ones."""

from __future__ import annotations

import random

import numpy as np
import pytest

from drivers.errors import FrameDecodeError
from drivers.logs.ros_image import image_encoding, parse_image
from tests.drivers.logs.mcap_logs import (
    COMPRESSED,
    IMAGE,
    LOWER,
    image,
    image_message,
)


@pytest.mark.parametrize("kind", [COMPRESSED, IMAGE])
def test_damaged_messages_raise_only_decode_errors(kind: str) -> None:
    chance = random.Random(8)
    whole = (
        image(LOWER, 10**18).data if kind == COMPRESSED else image_message(10**18, "mono8", np.zeros((4, 5), np.uint8))
    )
    for size in range(len(whole)):
        with pytest.raises(FrameDecodeError):
            parse_image(kind, memoryview(whole[:size]))
    for _ in range(2000):
        data = bytearray(whole)
        data[chance.randrange(min(80, len(data)))] = chance.randrange(256)
        try:
            assert parse_image(kind, memoryview(bytes(data))).stamp_ns >= 0
        except FrameDecodeError as error:
            assert "\n" not in str(error)


def test_encodings_have_one_name_and_rows_their_length() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    found = parse_image(IMAGE, memoryview(image_message(10**18 + 5, "8UC3", pixels)))
    assert (found.encoding, found.width, found.height, found.step, found.stamp_ns) == ("bgr8", 4, 2, 12, 10**18 + 5)
    assert bytes(found.data) == pixels.tobytes()


@pytest.mark.parametrize(
    ("data", "otherwise", "encoding"),
    [(b"\xff\xd8\xff\xe0", "png", "jpeg"), (b"\x89PNG", "jpeg", "png"), (b"RIFF", "jpeg", "jpeg"), (b"", "", "")],
)
def test_the_first_bytes_decide_the_compression(data: bytes, otherwise: str, encoding: str) -> None:
    assert image_encoding(data, otherwise) == encoding
