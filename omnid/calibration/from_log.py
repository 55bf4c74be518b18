"""Height and tilt of a rig by the floor in a log, and masks of what is fixed to its cameras.

The floor gives the height of the lower viewpoint. What stays in the images while the robot turns is fixed to a camera,
such as the reflection of a lens in its mirror.

Such a part is at the same rows of both panoramas whatever the base does: floor that falls deep beside the base would
look so, too. As the base turns each heading shows another part of the world there, and what is fixed stays. With n
headings whose normalised textures (core/obstacles/plane_view.py) have the mean m and the standard deviation s, a pixel
is fixed where

    m sqrt(n) / max(s, 1) > T_0.

Headings count, and not places, as lines along a corridor stay where they are while a base drives through it. Only what
lies well below the horizon is judged: the horizon itself, and walls far away, are where they are at all headings. A
part without a border along columns, such as an even strut, has m = 0: it shows nothing, and is no evidence by itself.
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from calib.rig import MountedCamera, Rig
from calib.rig_file import read_rig
from drivers.logs.log_reader import AnyCameras, LogCameras, LogReader
from omnid.calibration.drive_observations import tracked_updates
from omnid.calibration.rig_check import read_rig_pairs, with_masks
from omnid.config import Config
from omnid.core.floor import Floor, common_floor
from omnid.core.obstacles.plane_view import AROUND_ROWS, DIRECTIONS, FOCAL_PX, TEXTURE_SHARE
from omnid.core.types.panorama import PaddedPanorama
from omnid.errors import OmnidError
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry, geometry
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

MAX_PAIRS: Final = 12  # whose floors are compared


@dataclass(frozen=True, slots=True)
class HeightCalibration:
    """The floor below a rig, and the rig with it."""

    rig: Rig  # T_base_rig with the height and the tilt; the base is on the floor
    floor: Floor
    pairs: int

    def __str__(self) -> str:
        floor = self.floor
        return (
            f"height of the lower viewpoint {floor.height_m:.3f} m (sigma {floor.sigma_m:.3f}), tilt "
            f"{math.degrees(floor.tilt_rad):.2f} deg (sigma {math.degrees(floor.sigma_rad):.2f}), by the floor in "
            f"{self.pairs} pairs"
        )


def calibrate_height(
    log: str | PathLike[str], rig: str | PathLike[str] | Rig, topics: AnyCameras = (None, None)
) -> HeightCalibration:
    """Return height and tilt of a rig by pairs spread over a log; OmnidError where they do not show the floor.

    topics: of the lower and the upper camera. The tilt is against z of the base as the rig states it.
    """
    log, rig = Path(log), rig if isinstance(rig, Rig) else read_rig(Path(rig))
    cameras = LogCameras(*topics)
    pairs = read_rig_pairs(log, rig, cameras)
    config = Config()
    front_end = FrontEnd(geometry(with_masks(log, rig, cameras), config.panorama), config)
    view = se3.apply(rig.T_base_rig, rig.lower.viewpoint[None])[0]
    chosen = pairs[:: -(-len(pairs) // MAX_PAIRS)]
    depths = (front_end.dense.points(front_end.dewarp.process(pair)) for pair in chosen)
    floor = common_floor((se3.apply(rig.T_base_rig, one.points) - view, one.variance_m2) for one in depths)
    if floor is None:
        raise OmnidError(
            f"calibrate drive: {log}: the floor is not seen in {len(chosen)} pairs: record a log where "
            "the floor has texture all around (tiles, a carpet, newspapers), or give the measured height "
            "as --height-m to the command that makes the rig"
        )
    return HeightCalibration(on_floor(rig, floor), floor, len(chosen))


def on_floor(rig: Rig, floor: Floor) -> Rig:
    """Return the rig with its base on the floor and level; the tilt is drawn towards 0 by its prior."""
    view = se3.apply(rig.T_base_rig, rig.lower.viewpoint[None])[0]
    return replace(rig, T_base_rig=floor.T_floor_base(view) @ rig.T_base_rig)


HEADINGS: Final = 16  # of a full turn, 22 degrees apart, so that their textures have nothing in common
MIN_HEADINGS: Final = 12  # because after fewer headings more of a cluttered place seems to be fixed
# Least ratio of the mean and its standard error, because in a drive through clutter (872) 0.02 % of the pixels are
# above it after 12 headings, and borders of a lens have 10 to 60.
MIN_RATIO: Final = 6.0
# The band-pass shows the border of a part, so that what is between two of them belongs to it.
BETWEEN: Final = np.ones((AROUND_ROWS, 9), np.uint8)
# Shares of the panorama that may be fixed, because less is noise, and where more is images do not follow the heading.
MIN_FIXED_SHARE, MAX_FIXED_SHARE = 0.01, 0.3
MIN_FALL: Final = math.tan(math.radians(20))  # below the horizon, because floor there is within 2.5 m of a base


@dataclass(frozen=True, slots=True)
class MaskCalibration:
    """A rig whose masks hide what is fixed to its cameras."""

    rig: Rig
    share: float  # of the panorama, which the masks before did not hide

    def __str__(self) -> str:
        """Return the result as one line."""
        if not self.share:
            return "nothing is fixed to the cameras that the masks do not hide"
        return f"{100 * self.share:.1f} % of the panorama is fixed to a camera; the masks hide it"


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
    with closing(LogReader(log, cameras, rig.topics)) as reader:
        for update in tracked_updates(reader, front_end, log):
            pair = update.depth.panoramas
            if update.state is not TrackingState.LOST and not pair.tiles.is_frozen:
                parts.observe(update.of_base(place.rig.T_base_rig)[0], pair.lower, pair.upper, pair.visible)
            front_end.complete()
    if parts.headings < MIN_HEADINGS:
        raise OmnidError(
            f"calibrate drive: {log}: the robot shows {parts.headings} of {HEADINGS} headings of a turn, "
            f"{MIN_HEADINGS} are needed: record a log in which it turns once on the spot"
        )
    pixels = parts.pixels()
    # 2. The same in the images.
    lower, upper = (_masked(place, mounted, pixels) for mounted in (place.rig.lower, place.rig.upper))
    return MaskCalibration(replace(place.rig, lower=lower, upper=upper), float(pixels.mean()))


def _masked(place: Geometry, mounted: MountedCamera, pixels: Flags) -> MountedCamera:
    """Return a camera whose mask hides pixels (H, W) of the panorama."""
    if not pixels.any():
        return mounted
    width, height = mounted.camera.size
    v, u = np.indices((height, width))
    rays = mounted.camera.lift(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    at = place.cylinder.pixels(rays @ (se3.R_of(place.rig.T_rect_rig) @ se3.R_of(mounted.T_cam_rig).T).T)
    columns, rows = np.nan_to_num(at, nan=-1.0).astype(np.float32).T.reshape(2, height, width)
    hidden = cv2.remap(pixels.view(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    before = mounted.visible
    image = np.full((height, width), 255, np.uint8) if before.image is None else before.image
    return replace(mounted, mask=replace(before, image=np.where(hidden > 0, np.uint8(0), image)))


class FixedParts:
    """What is fixed to the cameras, by one pair of each heading."""

    def __init__(self, cylinder: Cylinder) -> None:
        self._shape = cylinder.height, cylinder.width
        rows = max(1, round(cylinder.height * FOCAL_PX / cylinder.focal_px))
        self._size = max(1, DIRECTIONS * cylinder.width // cylinder.period_px), rows
        self._first_row = round((cylinder.row0 + MIN_FALL * cylinder.focal_px) * rows / cylinder.height)
        self._views: dict[int, Floats] = {}  # (2, rows, columns) of the lower and the upper panorama, by heading
        self._heading = -1  # of the pair before

    @property
    def headings(self) -> int:
        """Return the number of headings, of HEADINGS, that were seen."""
        return len(self._views)

    def observe(self, T_odom_base: Array, lower: PaddedPanorama, upper: PaddedPanorama, visible: Flags) -> None:
        """Take a pair at a pose (4, 4) of the base, the first one of each turn to a heading.

        visible (H, W): pixels that show the world as far as the rig knows, the same in all pairs.
        """
        heading = int(float(se3.yaw(T_odom_base)) % math.tau / math.tau * HEADINGS) % HEADINGS
        if heading != self._heading:
            self._heading = heading
            shown = cv2.resize(visible.view(np.uint8), self._size, interpolation=cv2.INTER_AREA).astype(np.float32)
            self._views[heading] = np.stack([_texture(lower, shown), _texture(upper, shown)])

    def pixels(self) -> Flags:
        """Return the pixels (H, W) that show the same at all headings in either panorama."""
        views = np.stack(list(self._views.values()))
        # Textures are in units of their noise, of which a black lens shows less.
        mean, variance = views.mean(axis=0), np.maximum(views.var(axis=0, ddof=1), 1.0)
        found = (mean * mean * len(views) > MIN_RATIO**2 * variance).any(axis=0).view(np.uint8)
        found[: max(0, self._first_row)] = 0
        whole = cv2.morphologyEx(found, cv2.MORPH_CLOSE, BETWEEN)
        pixels = np.asarray(cv2.resize(whole, self._shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8) > 0
        return pixels if MIN_FIXED_SHARE <= pixels.mean() <= MAX_FIXED_SHARE else np.zeros(self._shape, bool)


def _texture(panorama: PaddedPanorama, shown: Floats) -> Floats:
    """Return how much a panorama differs from its columns around, in units of what two views differ by.

    shown: 1 in pixels of the small panorama that show the world, 0 in others, which count in no mean.
    """
    image = np.ascontiguousarray(panorama.panorama)
    small = shown * cv2.resize(image, shown.shape[::-1], interpolation=cv2.INTER_AREA)
    around = cv2.blur(small, (1, AROUND_ROWS)) / np.maximum(cv2.blur(shown, (1, AROUND_ROWS)), 1e-3)
    band = small - shown * around
    contrast2 = cv2.blur(band * band, (3, AROUND_ROWS))
    return np.asarray(band / np.sqrt(panorama.noise_grey**2 + TEXTURE_SHARE**2 * contrast2), np.float32)
