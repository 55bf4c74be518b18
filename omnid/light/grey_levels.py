"""Brightness of mirror images where the panoramas show them: black corners, hub and robot do not count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder, remap_tables, visible
from calib.rig import MountedCamera, Rig
from omnid.messages import FramePair

SAMPLE_STEP: Final = 8  # columns and rows of the panorama from sample to sample: some thousand samples
LEAST_COLUMNS: Final = 64
BRIGHT_PERCENT: Final = 97.0
MARGIN_PX: Final = 2.0  # Distance kept from the rim and the hub.


@dataclass(frozen=True, slots=True)
class GreyLevels:
    """Grey levels of an image in the useful area."""

    mean: float
    bright: float  # all but the brightest 3 % are below


class UsefulArea:
    """The pixels of both images that the panoramas are made of, evenly spread over the panorama."""

    def __init__(self, rig: Rig, cylinder: Cylinder) -> None:
        coarse = cylinder.resized(max(LEAST_COLUMNS, cylinder.width // SAMPLE_STEP))
        sides = [(mounted, remap_tables(rig, mounted, coarse)) for mounted in (rig.lower, rig.upper)]
        both = np.logical_and(*(visible(mounted, maps, MARGIN_PX) for mounted, maps in sides))
        self._pixels = [_flat(mounted, maps[0][both], maps[1][both]) for mounted, maps in sides]

    def levels(self, pair: FramePair) -> tuple[GreyLevels, GreyLevels]:
        """Return the levels of the lower and of the upper image."""
        lower, upper = (
            _levels(image.ravel()[pixels]) for image, pixels in zip((pair.lower, pair.upper), self._pixels, strict=True)
        )
        return lower, upper


def _flat(mounted: MountedCamera, u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return indices into the flattened image of pixels (u, v)."""
    return np.asarray(v.round().astype(np.intp) * mounted.camera.size[0] + u.round().astype(np.intp))


def _levels(grey: NDArray[np.uint8]) -> GreyLevels:
    return GreyLevels(float(grey.mean()), float(np.percentile(grey, BRIGHT_PERCENT)))
