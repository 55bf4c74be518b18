"""Decode the frames of the two cameras of a rig to grey images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.errors import FrameDecodeError
from drivers.frame import Camera, Frame, gray
from omnid.errors import OmnidError

Image = NDArray[np.uint8]


class Decoder:
    """Grey images of the size that the rig was calibrated for.

    `broken` counts the frames that could not be used, `fault` is the reason of the first of them.
    """

    def __init__(self, rig: Rig) -> None:
        self._sizes: dict[Camera, tuple[int, int]] = {"lower": rig.lower.camera.size, "upper": rig.upper.camera.size}
        self._fitted: set[Camera] = set()
        self.broken = 0
        self.fault = ""

    def __call__(self, frame: Frame) -> Image | None:
        """Return the image (H, W), or None for a frame that cannot be used.

        OmnidError if a camera's first image has another size than the rig's camera.
        """
        try:
            image = gray(frame)
        except FrameDecodeError as error:
            self._skip(str(error))
            return None
        found, expected = image.shape[::-1], self._sizes[frame.camera]
        if found == expected:
            self._fitted.add(frame.camera)
            return image
        if frame.camera not in self._fitted:
            raise OmnidError(
                f"the {frame.camera} camera's images are {found[0]}x{found[1]} px, the rig's are {expected[0]}x"
                f"{expected[1]} px: give the rig of these cameras with --rig"
            )
        self._skip(f"{frame.camera} frame {frame.seq} is {found[0]}x{found[1]} px, unlike those before")
        return None

    def _skip(self, fault: str) -> None:
        self.broken += 1
        self.fault = self.fault or fault
