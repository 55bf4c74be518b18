"""Panoramas from a recording that holds images and a rig."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np

from calib.errors import CalibError
from calib.panorama import fit_cylinder, remap_tables
from calib.rig import Rig
from drivers.errors import DriverError
from drivers.logs.log_reader import LogReader
from omnid.errors import OmnidError
from omnid.report.page import Image
from omnid.stages.decoder import Decoder

WIDTH_PX: Final = 1200
MAX_HEIGHT_PX: Final = 500
MAX_FRAMES: Final = 40_000  # Most images that are read: the first loss in a long log may be hours away.


class WantedImages(NamedTuple):
    """An image to show: the lower camera's first one from a time on."""

    stamp_ns: int
    caption: str


def panoramas(path: Path, rig: Rig, wanted: Sequence[WantedImages]) -> Iterator[tuple[Image, str]]:
    """Yield panoramas and their captions, as far as there are images. Raise OmnidError where none can be made."""
    try:
        cylinder = fit_cylinder(rig, WIDTH_PX)
        maps = remap_tables(rig, rig.lower, cylinder)
        for caption, image in _found(path, rig, wanted):
            panorama = cv2.remap(image, *maps, cv2.INTER_LINEAR)[:MAX_HEIGHT_PX]
            yield np.asarray(panorama, np.uint8), caption
    except (CalibError, DriverError, cv2.error) as error:
        raise OmnidError(" ".join(str(error).split())) from error


def _found(path: Path, rig: Rig, wanted: Sequence[WantedImages]) -> Iterator[tuple[str, Image]]:
    decode, left = Decoder(rig), sorted(wanted)
    with closing(LogReader(path)) as reader:
        for frame in islice(reader.frames(), MAX_FRAMES):
            if not left:
                return
            is_next = frame.camera == "lower" and frame.stamp_ns >= left[0].stamp_ns
            if is_next and (image := decode(frame)) is not None:
                yield left.pop(0).caption, image
