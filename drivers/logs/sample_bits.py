"""Images of 16 bits a sample from cameras of 10 or 12, in logs that are streamed."""

from __future__ import annotations

from contextlib import suppress

from drivers.errors import FrameDecodeError
from drivers.frame import FILE_BITS, bits_of_camera, deep_samples, upper_eight_bits
from drivers.logs.ros_messages import RosImage


class SampleBits:
    """The bits of each camera's samples, by the largest sample in its images so far.

    A camera whose first images are dark is read by two bits too few, four times as bright, until its first larger one.
    """

    def __init__(self) -> None:
        self._largest: dict[str, int] = {}  # by topic

    def applied(self, topic: str, image: RosImage) -> RosImage:
        """Return an image of a topic by the upper eight bits of its camera, the image itself where it has 8 or 16."""
        if bits_of_camera(self._largest.get(topic, 0)) == FILE_BITS:
            return image
        with suppress(FrameDecodeError):  # who decodes the image says what is wrong with it
            deep = deep_samples(image.frame())
            if deep is None:
                return image
            self._largest[topic] = max(self._largest.get(topic, 0), int(deep.max()))
            bits = bits_of_camera(self._largest[topic])
            if bits < FILE_BITS:
                pixels = memoryview(upper_eight_bits(deep, bits).tobytes())
                return RosImage(image.stamp_ns, "mono8", pixels, deep.shape[1], deep.shape[0])
        return image
