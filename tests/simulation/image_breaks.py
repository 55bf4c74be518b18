"""Images that break in the way from the sensor to the log: torn, displaced, turned, with lines twice or missing."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def tear(images: Sequence[Image], line: int, *, every: int = 1, since: int = 1) -> list[Image]:
    """Return images whose rows from a line on are those of the image before, in each `every`-th from an image on."""
    torn = list(images)
    for number in range(max(1, since), len(images), every):
        torn[number] = np.concatenate([images[number][:line], images[number - 1][line:]])
    return torn


def shift(images: Sequence[Image], by_px: tuple[int, int], *, since: int) -> list[Image]:
    """Return images that are displaced by (columns, rows) from one on; their edges are repeated."""
    return warp(images, np.array([[1.0, 0.0, by_px[0]], [0.0, 1.0, by_px[1]]]), since=since)


def turn(images: Sequence[Image], angle_deg: float, *, since: int) -> list[Image]:
    """Return images that are turned about their middle from one on, as by a mirror that has moved."""
    height, width = images[0].shape
    about = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1.0)
    return warp(images, np.asarray(about, float), since=since)


def warp(images: Sequence[Image], affine: NDArray[np.float64], *, since: int) -> list[Image]:
    """Return images that are mapped by an affine (2, 3) from one on; their edges are repeated."""
    height, width = images[0].shape
    return [
        np.asarray(cv2.warpAffine(image, affine, (width, height), borderMode=cv2.BORDER_REPLICATE), np.uint8)
        if number >= since
        else image
        for number, image in enumerate(images)
    ]


def repeat_lines(images: Sequence[Image], line: int, count: int, *, since: int) -> list[Image]:
    """Return images in which `count` rows from a line on are there twice; negative: so many are missing."""
    rows = np.arange(len(images[0]))
    source = np.where(rows < line, rows, np.clip(rows - count, 0, len(rows) - 1))
    return [image[source] if number >= since else image for number, image in enumerate(images)]


def roll(images: Sequence[Image], share: float, *, since: int = 1) -> list[Image]:
    """Return images whose rows are exposed one after the other, the last one by a share of a period before the first.

    They are warped by the dense flow from the image before, from one on.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    height, width = images[0].shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    late = np.float32(share) * y / np.float32(height)
    rolled = list(images[:since])
    for before, now in pairwise(images[since - 1 :]):
        back = flow.calc(now, before, np.zeros((height, width, 2), np.float32))
        at = x - late * back[:, :, 0], y - late * back[:, :, 1]
        rolled.append(np.asarray(cv2.remap(now, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8))
    return rolled
