"""Image of a panorama, a full turn that wraps around or a sector with two ends; and both panoramas of a pair."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.jpeg import Steps
from drivers.motion import MotionSample
from omnid.core.stereo.photometry import Light
from omnid.core.stereo.tiles import ALL_LIVE, TileStates
from omnid.core.types.pixel_times import SYNCHRONISED, PixelTimes

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class PaddedPanorama:
    """Panorama with pad_px columns more on either side, so that windows run across the seam of a full turn.

    The padding of a full turn repeats its last and first columns; that of a sector shows what the camera sees there.
    """

    image: Image  # (H, W + 2 pad) uint8
    pad_px: int
    noise_grey: float = 1.0  # standard deviation of the noise, grey levels
    gain: float = 1.0  # factor that was applied because the image was dim
    period_px: int = 0  # columns of a full turn, of which a sector has some; 0: all of them
    first: int = 0  # column of the full turn that is column 0
    jpeg_steps: Steps = ()  # of the quantisation of the image's JPEG, (): none
    scale: float = 1.0  # columns as a fraction of those at the images' own resolution

    def __post_init__(self) -> None:
        if not self.period_px:
            object.__setattr__(self, "period_px", self.width)

    @property
    def width(self) -> int:
        """Columns without the padding [px]."""
        return int(self.image.shape[1]) - 2 * self.pad_px

    @property
    def panorama(self) -> Image:
        """The panorama itself (H, W), a view."""
        return self.image[:, self.pad_px : self.pad_px + self.width]

    def own(self, columns: Array) -> Array:
        """Return columns (N,) of the panorama: wrapped into [0, W) for a full turn, unchanged for a sector."""
        return columns if self.period_px > self.width else np.asarray(columns % self.width)

    def in_turn(self, columns: Array) -> Array:
        """Return columns (N,) of the full turn, in [0, turn)."""
        return np.asarray((columns + self.first) % self.period_px)

    def padded(self, columns: Array) -> Array:
        """Return columns (N,) of the padded image: wrapped for a full turn, kept within it for a sector."""
        if self.period_px > self.width:
            return np.asarray(np.clip(columns, -self.pad_px, self.width - 1 + self.pad_px) + self.pad_px)
        return self.own(columns) + self.pad_px

    def unpadded(self, columns: Array) -> tuple[Array, Flags]:
        """Return columns (N,) of the panorama for columns of the padded image, and flags (N,): it has the column."""
        own = columns - self.pad_px
        if self.period_px > self.width:
            return own, np.asarray((own >= 0) & (own <= self.width - 1))
        return self.own(own), np.ones(len(own), bool)

    def wrap(self, columns: Array) -> Array:
        """Return differences (N,) of columns, the short way around a full turn."""
        return np.asarray((columns + self.period_px / 2) % self.period_px - self.period_px / 2)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Panoramas:
    """Both images on the cylinder about the line through the viewpoints: epipolar lines are columns."""

    seq: int
    stamp_ns: int
    lower: PaddedPanorama
    upper: PaddedPanorama
    visible: Flags  # (H, W) both cameras show the world here and in a tracking window around
    times: PixelTimes = SYNCHRONISED
    light: Light = field(default_factory=Light)
    motion: tuple[MotionSample, ...] = ()  # samples of wheels and gyro since the last pair
    tiles: TileStates = ALL_LIVE  # the parts of the images that are dead or blind

    @property
    def usable(self) -> Flags:
        """Pixels (H, W) that show the world in live parts of both images."""
        lost = self.tiles.lost_pixels(self.visible.shape)
        return self.visible if lost is None else self.visible & ~lost
