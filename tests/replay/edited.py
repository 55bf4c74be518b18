"""Logs whose messages are edited one by one, and images that break on the way from the sensor to the log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.logs.log_reader import LogCameras, LogReader
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
    reader = LogReader(log, LogCameras(lower, upper))
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


Pixels = NDArray[np.uint8]


def tear(images: Sequence[Pixels], line: int, *, since: int) -> list[Pixels]:
    """Return images whose rows from a line on are those of the image before, from one on."""
    torn = list(images)
    for number in range(since, len(images)):
        torn[number] = np.concatenate([images[number][:line], images[number - 1][line:]])
    return torn


def shift(images: Sequence[Pixels], by_px: tuple[int, int], *, since: int) -> list[Pixels]:
    """Return images that are displaced by (columns, rows) from one on; their edges are repeated."""
    return warp(images, np.array([[1.0, 0.0, by_px[0]], [0.0, 1.0, by_px[1]]]), since=since)


def turn(images: Sequence[Pixels], angle_deg: float, *, since: int) -> list[Pixels]:
    """Return images that are turned about their middle from one on, as by a mirror that has moved."""
    height, width = images[0].shape
    about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1.0)
    return warp(images, np.asarray(about, float), since=since)


def warp(images: Sequence[Pixels], affine: NDArray[np.float64], *, since: int) -> list[Pixels]:
    """Return images that are mapped by an affine (2, 3) from one on; their edges are repeated."""
    height, width = images[0].shape
    return [
        np.asarray(cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8)
        if number >= since
        else image
        for number, image in enumerate(images)
    ]


def repeat_lines(images: Sequence[Pixels], line: int, count: int, *, since: int) -> list[Pixels]:
    """Return images in which `count` rows from a line on are there twice; negative: so many are missing."""
    rows = np.arange(len(images[0]))
    source = np.where(rows < line, rows, np.clip(rows - count, 0, len(rows) - 1))
    return [image[source] if number >= since else image for number, image in enumerate(images)]


def roll(images: Sequence[Pixels]) -> list[Pixels]:
    """Return images whose rows are exposed one after the other, the last one by a period before the first.

    They are warped by the dense flow from the image before, which the first one does not have.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    height, width = images[0].shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    late = y / np.float32(height)
    rolled = list(images[:1])
    for before, now in pairwise(images):
        back = flow.calc(now, before, np.zeros((height, width, 2), np.float32))
        at = x - late * back[:, :, 0], y - late * back[:, :, 1]
        rolled.append(np.asarray(cv2.remap(now, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8))
    return rolled
