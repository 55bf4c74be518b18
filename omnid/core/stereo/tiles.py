"""Live parts of images: tiles of a panorama that are dead or blind, and the directions in which nothing is known.

A whole image that repeats is left out before (stages/synchronise.py). A part of one is used in a pair that tracks:
a region that a driver no longer writes, dirt or a drop on a mirror, darkness, glare. Each is a property of a tile:

    dead      each pixel is as in the image before, or less changed than the noise of a live image changes it,
              twice in a row, while other tiles change. Noise changes a live tile even where nothing moves.
    dark      its mean is not above black, and hardly anything is in it but noise
    glaring   most of its pixels are saturated
    blurred   a column of tiles has less gradient energy than the same column of the other camera, which sees the
              same things from 0.1 to 0.4 m above or below; the median over all columns is the two cameras' own ratio

The last three are blind. A direction is unknown where one tile of either camera is dead, or too many are blind.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.panorama import Cylinder

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int32]

# Of a full turn; a sector has fewer. So many because 6 degrees, 15 columns of a panorama at scale 1 (512 px images),
# are less than the narrowest part that matters.
TILE_COLUMNS: Final = 60
TILE_ROWS: Final = 4  # 63 rows at scale 1.
# Rows and columns from one counted pixel to the next, because a quarter of the pixels is enough in a quarter of the
# time, where a tile has MIN_SAMPLES of them: a few may keep their greys by chance, as at 160 px.
SPACING_PX: Final = 2
MIN_SAMPLES: Final = 100
SATURATED_GREY: Final = 250  # grey level from which a pixel is saturated
# Share of a tile that must show the world, and share of the judged tiles of a column beyond which its direction is
# unknown if they are blind.
MAJORITY: Final = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class TileSums:
    """Sums over the pixels of each tile (TILE_ROWS, C) that show the world, in a part of all rows and columns."""

    pixels: Numbers  # their number
    grey: Numbers
    square: Numbers  # of the grey levels
    saturated: Numbers  # pixels
    change: Numbers  # of the grey levels since the panorama before; 0 of the first one


def borders(pixels: int, tiles: int) -> NDArray[np.int32]:
    """Return the first pixel of each tile along a side, and the end (tiles + 1,)."""
    return np.rint(np.arange(tiles + 1) * pixels / tiles).astype(np.int32)


Array = NDArray[np.float64]
Side = Literal["lower", "upper"]
SIDES: Final[tuple[Side, Side]] = ("lower", "upper")

IN_A_ROW: Final = 2  # pairs that find a tile dead or blurred before it counts, because one may be a glitch of a driver
# Share of the judged tiles that must change before others are dead, because else the whole image is still.
MIN_CHANGED_SHARE: Final = 0.1
# Share of the mean change by noise that a live tile shows at least, because the noise is that of the smoothest blocks,
# and pixels of a panorama are interpolated from compressed images: in the sample log it is a fifth.
NOISE_SHARE: Final = 0.1
MEASURED_NOISE_GREY: Final = 1.0  # less is that of rounding and compression, and says nothing about a tile
# Cameras that remove noise repeat plain tiles while the base is at rest, so that a tile without texture is dead only if
# it has changed in nearly all pairs before, by the mean of the newest 1 / LIVELY_GAIN.
TEXTURE_GREY: Final = 4.0  # standard deviation, because it is more than what such a camera leaves of the noise
LIVELY_GAIN, LIVELY_SHARE = 0.1, 0.75
BLACK_GREY: Final = 16.0  # black of limited-range video (source: ITU-R BT.601)
DARK_CONTRAST: Final = 1.5  # standard deviation of a dark tile in those of the noise, because more is a dim scene
SATURATED_SHARE: Final = 0.8  # of the pixels of a tile.
# A column is blurred if its energy by the other camera's is below this share of the usual, in BLURRED_COLUMNS columns,
# because a poster that only one camera sees is all the texture of a column: 0.15 was left in rendered corridors. A drop
# leaves less.
BLURRED_SHARE: Final = 0.1
BLURRED_COLUMNS: Final = 3
MIN_ENERGY: Final = 2.0  # Energy of a column, in variances of the noise, because with less texture no blur is seen.


@dataclass(frozen=True, slots=True, eq=False)
class TileStates:
    """State of the tiles of a pair."""

    dead: dict[Side, Flags] = field(default_factory=dict)  # (TILE_ROWS, C), C the panorama's columns of tiles
    blind: dict[Side, Flags] = field(default_factory=dict)  # the same
    columns: dict[Side, Flags] = field(default_factory=dict)  # (C,) in which it shows nothing to rely on

    @property
    def unknown(self) -> Flags:
        """Return the columns of tiles (C,) in which the pair shows nothing to rely on."""
        return np.asarray(np.logical_or.reduce(list(self.columns.values()) or [np.zeros(TILE_COLUMNS, bool)]))

    @property
    def is_frozen(self) -> bool:
        """Return whether a part of an image is dead."""
        return any(tiles.any() for tiles in self.dead.values())

    def lost_pixels(self, shape: tuple[int, ...]) -> Flags | None:
        """Return the pixels (H, W) of directions that are unknown, and of single tiles that are dead or blind.

        Both panoramas share columns, but a point lies in different rows of them. None: all tiles live.
        """
        if not self.columns:
            return None
        single = [states[side] for states in (self.dead, self.blind) for side in SIDES]
        tiles = np.logical_or.reduce([np.repeat(self.unknown[None], TILE_ROWS, axis=0), *single])
        size = shape[1], shape[0]
        return np.asarray(cv2.resize(tiles.view(np.uint8), size, interpolation=cv2.INTER_NEAREST), np.uint8) > 0


ALL_LIVE: Final = TileStates()


class TileMonitor:
    """Follows the tiles of both panoramas from pair to pair."""

    def __init__(self, visible: Flags, columns: int = TILE_COLUMNS) -> None:
        """visible (H, W): pixels that show the world; columns of tiles in W."""
        # 1. The sums of each tile; those that show less of the world are not judged.
        self._spacing_px = SPACING_PX if visible.size >= MIN_SAMPLES * SPACING_PX**2 * TILE_ROWS * columns else 1
        self._mask = self._sampled(np.where(visible, np.uint8(255), np.uint8(0)))
        self._rows, self._columns = borders(self._mask.shape[0], TILE_ROWS), borders(self._mask.shape[1], columns)
        self._before: dict[Side, Image] = {}
        self._pixels = self._tile_sums(np.asarray(self._mask & 1, np.uint8))
        self._judged = self._pixels >= MAJORITY * np.diff(self._rows)[:, None] * np.diff(self._columns)
        self._counts = np.maximum(self._pixels, 1)
        # 2. Pixels at half resolution, all of which show the world, and so do their neighbours.
        height, width = visible.shape[0] // 2, visible.shape[1] // 2
        shown = cv2.erode(visible.astype(np.uint8), np.ones((5, 5), np.uint8))[: 2 * height, : 2 * width]
        half = shown.reshape(height, 2, width, 2).min(axis=(1, 3))
        self._half_mask, self._half_columns = 255 * half, borders(width, columns)[:-1]
        self._half_counts = np.maximum(np.add.reduceat(half.sum(axis=0, dtype=np.int64), self._half_columns), 1)
        self._lively = {side: np.zeros(self._judged.shape) for side in SIDES}  # share of pairs that changed
        self._still = {side: np.zeros(self._judged.shape, np.intp) for side in SIDES}  # pairs in a row without change
        self._faint = {side: np.zeros(columns, np.intp) for side in SIDES}  # pairs in a row with little energy

    def sums(self, side: Side, panorama: Image) -> TileSums:
        """Return the sums of a camera's next panorama (H, W) as the camera gave it."""
        sample = np.asarray(cv2.bitwise_and(self._sampled(panorama), self._mask), np.uint8)
        before, self._before[side] = self._before.get(side), sample
        saturated = np.asarray(cv2.threshold(sample, SATURATED_GREY - 1, 1, cv2.THRESH_BINARY)[1], np.uint8)
        change = np.asarray(cv2.absdiff(sample, sample if before is None else before), np.uint8)
        grey, square = self._tile_sums(sample), self._tile_sums(sample, cv2.REDUCE_SUM2)
        return TileSums(self._pixels, grey, square, self._tile_sums(saturated), self._tile_sums(change))

    def _sampled(self, image: Image) -> Image:
        return np.ascontiguousarray(image[:: self._spacing_px, :: self._spacing_px])

    def _tile_sums(self, image: Image, operation: int = cv2.REDUCE_SUM) -> Numbers:
        """Return the sums (TILE_ROWS, C) of an image over each tile, or those of its squares."""
        bands = [image[low:high] for low, high in pairwise(self._rows)]
        by_column = np.array([cv2.reduce(band, 0, operation, dtype=cv2.CV_64F)[0] for band in bands])
        return np.add.reduceat(by_column, self._columns[:-1], axis=1).astype(np.int32)

    def update(
        self, images: dict[Side, Image], sums: dict[Side, TileSums], noise_grey: dict[Side, float]
    ) -> TileStates:
        """Return the states for panoramas (H, W) as the cameras gave them, with their sums and their noise."""
        # 1. What each camera shows by itself.
        blind, dead = {}, {}
        for side, found in sums.items():
            grey, square = found.grey / self._counts, found.square / self._counts
            contrast = np.sqrt(np.maximum(square - grey**2, 0.0))
            saturated, change = found.saturated / self._counts, found.change / self._counts
            is_dark = contrast < DARK_CONTRAST * max(noise_grey[side], MEASURED_NOISE_GREY)
            is_dark &= grey < BLACK_GREY
            blind[side] = np.asarray(self._judged & (is_dark | (saturated > SATURATED_SHARE)))
            dead[side] = self._dead(side, change, contrast, blind[side], noise_grey[side])
        # 2. What one camera does not show that the other one does.
        energy = {side: self._energy(images[side]) for side in SIDES}
        for side, other in zip(SIDES, reversed(SIDES), strict=True):
            blind[side] |= self._judged & self._blurred(side, energy[side], energy[other], noise_grey[other])
        # 3. Directions.
        counts = np.maximum(self._judged.sum(axis=0), 1)
        columns = {side: dead[side].any(axis=0) | (blind[side].sum(axis=0) > MAJORITY * counts) for side in SIDES}
        if not any(states[side].any() for states in (dead, blind) for side in SIDES):
            return ALL_LIVE
        return TileStates(dead, blind, columns)

    def _dead(self, side: Side, change: Array, contrast: Array, blind: Flags, noise_grey: float) -> Flags:
        """Return the tiles of a camera that do not change, by the mean change and the contrast (TILE_ROWS, C).

        blind: dark and saturated ones, which have no noise.
        """
        # The mean change between two images with independent normal noise of sigma is 2 sigma / sqrt(pi).
        of_noise = 2 * noise_grey / np.sqrt(np.pi)
        least = NOISE_SHARE * of_noise if noise_grey >= MEASURED_NOISE_GREY else 0.0
        shows = self._judged & ~blind
        is_still = shows & (change <= least)
        lively = self._lively[side]
        may_be_dead = is_still & ((contrast > TEXTURE_GREY) | (lively > LIVELY_SHARE))
        enough = (shows & ~is_still).sum() >= MIN_CHANGED_SHARE * max(1, int(shows.sum()))
        self._still[side] = np.where(may_be_dead & enough, self._still[side] + 1, 0)
        # While a tile is still, its liveliness stays as it was before.
        self._lively[side] = np.where(self._still[side] > 0, lively, lively + LIVELY_GAIN * (~is_still - lively))
        return np.asarray(self._still[side] >= IN_A_ROW)

    def _energy(self, image: Image) -> Array:
        """Return the gradient energy (C,) of columns of tiles at half resolution, grey levels squared.

        There the noise is halved, and the texture that dirt takes away is not.
        """
        height, width = self._half_mask.shape
        half = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        # The first row and the first column have no neighbour before them.
        beside = cv2.copyMakeBorder(half, 1, 0, 1, 0, cv2.BORDER_REPLICATE)
        steps = [cv2.absdiff(half, before) & self._half_mask for before in (beside[1:, :-1], beside[:-1, 1:])]
        by_column = sum(cv2.reduce(step, 0, cv2.REDUCE_SUM2, dtype=cv2.CV_64F)[0] for step in steps)
        return np.asarray(np.add.reduceat(by_column, self._half_columns) / self._half_counts)

    def _blurred(self, side: Side, energy: Array, other: Array, noise_grey: float) -> Flags:
        """Return the columns (C,) in which a camera shows far less than the other one does."""
        textured = other > MIN_ENERGY * max(noise_grey, MEASURED_NOISE_GREY) ** 2
        ratio = energy / np.maximum(other, 1e-6)
        is_faint = np.zeros(len(energy), bool)
        # With texture in less than a quarter of a turn, a single poster would decide what is usual.
        if textured.sum() >= TILE_COLUMNS // 4:
            is_faint = textured & (ratio < BLURRED_SHARE * float(np.median(ratio[textured])))
        if not is_faint.any():
            self._faint[side][:] = 0
            return is_faint
        # Runs of such columns, and those next to them, which dirt covers in part.
        is_wide = np.logical_and.reduce([np.roll(is_faint, -shift) for shift in range(BLURRED_COLUMNS)])
        is_faint = np.logical_or.reduce([np.roll(is_wide, shift) for shift in range(-1, BLURRED_COLUMNS + 1)])
        self._faint[side] = np.where(is_faint, self._faint[side] + 1, 0)
        return np.asarray(self._faint[side] >= IN_A_ROW)


def tile_columns(cylinder: Cylinder) -> int:
    """Return the number of columns of tiles of a panorama."""
    return max(1, round(TILE_COLUMNS * cylinder.width / cylinder.period_px))
