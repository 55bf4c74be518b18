"""The frame of an image message."""

from __future__ import annotations

from drivers.frame import Camera, Frame
from drivers.logs.ros_image import RosImage


def frame_of(image: RosImage, camera: Camera = "lower", seq: int = 0) -> Frame:
    """Return an image as a frame of a camera. To decode it, neither the camera nor the number matters."""
    return Frame(
        seq,
        image.stamp_ns,
        camera,
        image.encoding,
        image.data,
        image.width,
        image.height,
        image.step,
        image.bigendian,
    )
