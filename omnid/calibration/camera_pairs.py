"""Pairs of images from two cameras that view a scene that does not move."""

from __future__ import annotations

import time
from collections.abc import Iterator

from drivers.errors import FrameDecodeError
from drivers.frame import Frame, FrameSource, gray
from omnid.calibration.images import Image


def newest_pairs(lower: FrameSource, upper: FrameSource) -> Iterator[tuple[Image, Image]]:
    """Yield pairs of images that were taken since the pair was asked for; the cameras take turns.

    What they see must stand still meanwhile, which the caller checks. Images that waited in a buffer are left out, so
    that a slow caller sees what is there now. Ends with either camera.
    """
    frames = lower.frames(), upper.frames()
    while True:
        pair = []
        for source in frames:
            image = _image_after(source, time.monotonic_ns())
            if image is None:
                return
            pair.append(image)
        yield pair[0], pair[1]


def _image_after(frames: Iterator[Frame], asked_ns: int) -> Image | None:
    """Return the first image with a stamp not before that; None at the end."""
    for frame in frames:
        if frame.stamp_ns >= asked_ns:
            try:
                return gray(frame)
            except FrameDecodeError:
                continue
    return None
