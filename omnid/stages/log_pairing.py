"""Two images of one instant out of the frames of two cameras."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.errors import BrokenFrame
from drivers.frame import Camera, Frame, gray
from omnid.config import PairConfig
from omnid.errors import OmnidError
from omnid.messages import FramePair

Image = NDArray[np.uint8]


class Decoder:
    """Grey images of the size the rig was calibrated for; `broken` counts the frames that gave none.

    `fault` says why the first of these did not.
    """

    def __init__(self, rig: Rig) -> None:
        self._sizes: dict[Camera, tuple[int, int]] = {"lower": rig.lower.camera.size, "upper": rig.upper.camera.size}
        self._fitted: set[Camera] = set()
        self.broken = 0
        self.fault = ""

    def __call__(self, frame: Frame) -> Image | None:
        """The image (H, W), or None; OmnidError where a camera's first one has another size than the rig's."""
        try:
            image = gray(frame)
        except BrokenFrame as error:
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


class _Waiting(NamedTuple):
    camera: Camera
    stamp_ns: int
    image: Image


class PairSync:
    """Joins frames that come in the order of their stamps; what finds no partner in time is counted.

    In that order only the newest frame can still find one, so no more than one waits.
    """

    def __init__(self, rig: Rig, config: PairConfig) -> None:
        self._decode = Decoder(rig)
        self._tolerance_ns = round(config.tolerance_ms * 1e6)
        self._waiting: _Waiting | None = None
        self._unpaired: Counter[Camera] = Counter()
        self._pairs = 0
        self._nearest_ns: int | None = None

    @property
    def fault(self) -> str:
        """Why the first of the broken images could not be decoded; empty where there is none."""
        return self._decode.fault

    @property
    def nearest_ms(self) -> float | None:
        """How near in time two images came of which no pair was made; None where there were no such two."""
        return None if self._nearest_ns is None else self._nearest_ns * 1e-6

    @property
    def counts(self) -> dict[str, int]:
        """Pairs made, frames of either camera that found no partner, images that could not be decoded."""
        return {"pairs": self._pairs, "unpaired_lower": self._unpaired["lower"],
                "unpaired_upper": self._unpaired["upper"], "broken": self._decode.broken}

    def process(self, frame: Frame) -> FramePair | None:
        """The pair that this frame completes."""
        image = self._decode(frame)
        if image is None:
            return None
        late, self._waiting = self._waiting, _Waiting(frame.camera, frame.stamp_ns, image)
        if late is None:
            return None
        gap_ns = frame.stamp_ns - late.stamp_ns
        if late.camera != frame.camera and gap_ns <= self._tolerance_ns:
            return self._joined(late, self._waiting)
        self._unpaired[late.camera] += 1
        if late.camera != frame.camera:
            self._nearest_ns = gap_ns if self._nearest_ns is None else min(gap_ns, self._nearest_ns)
        return None

    def finish(self) -> tuple[()]:
        """Counts the frame that still waits."""
        if self._waiting is not None:
            self._unpaired[self._waiting.camera] += 1
            self._waiting = None
        return ()

    def _joined(self, a: _Waiting, b: _Waiting) -> FramePair:
        lower, upper = (a, b) if a.camera == "lower" else (b, a)
        self._waiting, seq = None, self._pairs
        self._pairs += 1
        return FramePair(seq, lower.stamp_ns, lower.image, upper.image)
