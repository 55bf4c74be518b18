"""Images of 16 bits a sample are as bright as those of 8, whatever the bits of the camera are."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.frame import gray
from drivers.logs.ros_messages import RosImage
from drivers.logs.sample_bits import SampleBits


def deep(largest: int) -> RosImage:
    samples = np.linspace(0, largest, 12).astype("<u2").reshape(3, 4)
    return RosImage(1, "mono16", memoryview(samples.tobytes()), 4, 3, 8)


@pytest.mark.parametrize("largest", [1023, 4095, 65535])
def test_the_brightest_sample_of_a_camera_is_white(largest: int) -> None:
    assert gray(SampleBits().applied("/lower", deep(largest)).frame()).max() == 255


def test_bits_are_those_of_the_largest_sample_so_far_of_each_topic() -> None:
    bits = SampleBits()
    bits.applied("/lower", deep(4095))
    assert gray(bits.applied("/lower", deep(1023)).frame()).max() == 63
    assert gray(bits.applied("/upper", deep(1023)).frame()).max() == 255


def test_images_of_8_bits_and_damaged_ones_stay_as_they_are() -> None:
    bits = SampleBits()
    for image in (
        RosImage(1, "mono8", memoryview(bytes(12)), 4, 3, 4),
        RosImage(1, "mono16", memoryview(b"ab"), 4, 3, 8),
    ):
        assert bits.applied("/lower", image) is image
