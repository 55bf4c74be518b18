"""Masks of what is fixed to a camera, from a log in which the robot turns: the reflection of a lens in its mirror."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import remap_tables
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig, write_rig
from drivers.logs.log_reader import AnyCameras, LogCameras
from omnid.calibration.drive_observations import tracked_updates
from omnid.calibration.images import open_log
from omnid.calibration.rig_check import with_masks
from omnid.config import Config
from omnid.core.frames import of_base
from omnid.core.obstacles.fixed_parts import HEADINGS, LEAST_HEADINGS, FixedParts
from omnid.errors import OmnidError
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.tracking_state import TrackingState

Flags = NDArray[np.bool_]

# Pixels of a panorama are up to some pixels of an image apart: what is between those of a part belongs to it.
WITHIN: Final = np.ones((7, 7), np.uint8)


@dataclass(frozen=True, slots=True)
class MaskCalibration:
    """A rig whose masks hide what is fixed to its cameras."""

    rig: Rig
    share: float  # of the panorama, which the masks before did not hide
    headings: int  # of HEADINGS, by which it was found

    def __str__(self) -> str:
        """Return the result as one line."""
        if not self.share:
            return f"nothing is fixed to the cameras that the masks do not hide, by {self.headings} headings of a turn"
        return (
            f"{100 * self.share:.1f} % of the panorama is fixed to a camera, by {self.headings} headings of a turn; "
            "the masks hide it"
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the rig.toml, and its masks as PNGs beside it."""
        write_rig(Path(path), self.rig)


def calibrate_mask(
    log: str | PathLike[str], rig: str | PathLike[str] | Rig, topics: AnyCameras = (None, None)
) -> MaskCalibration:
    """Return the rig with masks of what is fixed to its cameras; OmnidError where the robot turns too little.

    topics: of the lower and the upper camera. A part that one camera shows is masked in both, as obstacles are judged
    where both panoramas show the world.
    """
    log, rig = Path(log), rig if isinstance(rig, Rig) else read_rig(Path(rig))
    config = Config()
    # 1. What stays at all headings of the log, in the panoramas.
    cameras = LogCameras(*topics)
    place = geometry(with_masks(log, rig, cameras), config.panorama)
    front_end, parts = FrontEnd(place, config), FixedParts(place.cylinder)
    with closing(open_log(log, cameras, rig)) as reader:
        for update in tracked_updates(reader, front_end, config, log):
            pair = update.depth.panoramas
            if update.state is not TrackingState.LOST and not pair.tiles.is_frozen:
                parts.observe(of_base(update, place.rig.T_base_rig)[0], pair.lower, pair.upper, pair.visible)
            front_end.odometry.complete()
    if parts.headings < LEAST_HEADINGS:
        raise OmnidError(
            f"calibrate drive: {log}: the robot shows {parts.headings} of {HEADINGS} headings of a turn, "
            f"{LEAST_HEADINGS} are needed: record a log in which it turns once on the spot"
        )
    parts.judge()
    # 2. The same in the images.
    lower, upper = (_masked(place, mounted, parts.pixels) for mounted in (place.rig.lower, place.rig.upper))
    return MaskCalibration(replace(place.rig, lower=lower, upper=upper), parts.share, parts.headings)


def _masked(place: Geometry, mounted: MountedCamera, pixels: Flags) -> MountedCamera:
    """Return a camera whose mask hides pixels (H, W) of the panorama."""
    if not pixels.any():
        return mounted
    width, height = mounted.camera.size
    u, v = (np.rint(table[pixels]).astype(int) for table in remap_tables(place.rig, mounted, place.cylinder))
    shown = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    hidden = np.zeros((height, width), np.uint8)
    hidden[v[shown], u[shown]] = 255
    hidden = np.asarray(cv2.morphologyEx(hidden, cv2.MORPH_CLOSE, WITHIN), np.uint8)
    before = mounted.visible
    image = np.full((height, width), 255, np.uint8) if before.image is None else before.image
    return replace(mounted, mask=replace(before, image=np.where(hidden > 0, np.uint8(0), image)))
