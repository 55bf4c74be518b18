"""Logs whose messages are edited one by one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from drivers.logs.log_reader import LogReader
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, UPPER, Entry, compressed, write_log

PERIOD_NS = 100_000_000


@dataclass(frozen=True, slots=True)
class Image:
    """An image of a log; `pair` counts from 0, `written_ns` is the time of recording."""

    camera: str
    pair: int
    stamp_ns: int
    jpeg: bytes
    written_ns: int

    def later(self, pairs: int) -> Image:
        """Return the same image so many pairs later."""
        shift_ns = pairs * PERIOD_NS
        return replace(
            self, pair=self.pair + pairs, stamp_ns=self.stamp_ns + shift_ns, written_ns=self.written_ns + shift_ns
        )


def images(log: Path, lower: str | None = None, upper: str | None = None) -> list[Image]:
    """Return the images of a log, in the order of their stamps; lower, upper: topics, None: by their names."""
    reader = LogReader(log, lower, upper)
    taken = [Image(f.camera, f.seq, f.stamp_ns, bytes(f.data), f.stamp_ns) for f in reader.frames()]
    reader.close()
    return taken


def save(path: Path, taken: Iterable[Image]) -> Path:
    """Write a log of these images, in their order, and return its path."""
    topics = {"lower": LOWER, "upper": UPPER}
    entries = [Entry(topics[p.camera], COMPRESSED, compressed(p.stamp_ns, p.jpeg), p.written_ns) for p in taken]
    return write_log(path, entries)


def dark(image: Image) -> Image:
    """Return the image of a camera in the dark: noise."""
    size = cv2.imdecode(np.frombuffer(image.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape
    noise = np.random.default_rng(image.pair).integers(0, 4, size, np.uint8)
    return replace(image, jpeg=cv2.imencode(".jpg", noise)[1].tobytes())
