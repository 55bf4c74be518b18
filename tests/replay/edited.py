"""Real logs with something done to them, message by message."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from drivers.logs.mcap_reader import LogReader
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, UPPER, Entry, compressed, write_log

PERIOD_NS = 100_000_000


@dataclass(frozen=True, slots=True)
class Image:
    """A image as a camera sent it; `pair` counts from 0, `written_ns` is when the recorder got it."""

    camera: str
    pair: int
    stamp_ns: int
    jpeg: bytes
    written_ns: int

    def later(self, pairs: int) -> Image:
        """The same image so many pairs later."""
        shift_ns = pairs * PERIOD_NS
        return replace(self, pair=self.pair + pairs, stamp_ns=self.stamp_ns + shift_ns,
                       written_ns=self.written_ns + shift_ns)


def images(log: Path) -> list[Image]:
    """The images of a log, in the order of their stamps."""
    reader = LogReader(log)
    taken = [Image(f.camera, f.seq, f.stamp_ns, bytes(f.data), f.stamp_ns) for f in reader.frames()]
    reader.close()
    return taken


def save(path: Path, taken: Iterable[Image]) -> Path:
    """A log of these images, in their order; its path."""
    topics = {"lower": LOWER, "upper": UPPER}
    entries = [Entry(topics[p.camera], COMPRESSED, compressed(p.stamp_ns, p.jpeg), p.written_ns) for p in taken]
    return write_log(path, entries)


def dark(image: Image) -> Image:
    """What the camera sees when the light is off: noise."""
    size = cv2.imdecode(np.frombuffer(image.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape
    night = np.random.default_rng(image.pair).integers(0, 4, size, np.uint8)
    return replace(image, jpeg=cv2.imencode(".jpg", night)[1].tobytes())
