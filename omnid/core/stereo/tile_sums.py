"""Sums over the tiles of panoramas: one pass over the pixels, for brightness, contrast and live parts of images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.core.stereo.tile_kernels import tile_sums

Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int32]

# Of a full turn; a sector has fewer. So many because 6 degrees, 15 columns of a panorama at scale 1 (512 px images),
# are less than the narrowest part that matters.
TILE_COLUMNS: Final = 60
TILE_ROWS: Final = 4  # 63 rows at scale 1.
# Rows and columns from one counted pixel to the next, because a quarter of the pixels is enough in a quarter of the
# time, where a tile has LEAST_SAMPLES of them: a few may keep their greys by chance, as at 160 px.
SPACING_PX: Final = 2
LEAST_SAMPLES: Final = 100
# Grey level from which a pixel is saturated.
SATURATED_GREY: Final = np.uint8(250)


@dataclass(frozen=True, slots=True, eq=False)
class TileSums:
    """Sums over the pixels of each tile (TILE_ROWS, C) that show the world, in a part of all rows and columns."""

    pixels: Numbers  # their number
    grey: Numbers
    square: Numbers  # of the grey levels
    saturated: Numbers  # pixels
    change: Numbers  # of the grey levels since the panorama before; 0 of the first one
    is_first: bool


class TileSampler:
    """Sums of the panoramas (H, W) of one camera."""

    def __init__(self, visible: Flags, columns: int = TILE_COLUMNS) -> None:
        """visible (H, W): pixels that show the world; columns of tiles in W."""
        self._shape, self._columns = visible.shape, columns
        tile_pixels = visible.size / (TILE_ROWS * columns)
        self._spacing_px = SPACING_PX if tile_pixels >= LEAST_SAMPLES * SPACING_PX**2 else 1
        self._visible = self._sample(visible.view(np.uint8))
        self._tiles = borders(self._visible.shape[0], TILE_ROWS), borders(self._visible.shape[1], columns)
        ones = np.ones_like(self._visible)
        self.pixels = self._sums(ones, ones)[0]
        self._before: Image | None = None

    @property
    def areas(self) -> Numbers:
        """Pixels (TILE_ROWS, C) of each tile that are counted where all of it shows the world."""
        return np.asarray(np.diff(self._tiles[0])[:, None] * np.diff(self._tiles[1]))

    def add(self, panorama: Image) -> TileSums:
        """Return the sums of the next panorama (H, W).

        Raises ValueError if it has another shape: the compiled loops do not check their bounds.
        """
        if panorama.shape != self._shape:
            raise ValueError(f"a panorama is {panorama.shape}, not {self._shape}")
        sample = self._sample(panorama)
        before, self._before = self._before, sample
        grey, square, saturated, change = self._sums(sample, sample if before is None else before)
        return TileSums(self.pixels, grey, square, saturated, change, before is None)

    def _sample(self, image: Image) -> Image:
        return np.ascontiguousarray(image[:: self._spacing_px, :: self._spacing_px])

    def _sums(self, image: Image, before: Image) -> NDArray[np.int32]:
        """Return the sums (4, TILE_ROWS, C) of `tile_sums` of samples of an image and the one before."""
        sums = np.empty((4, TILE_ROWS, self._columns), np.int32)
        tile_sums(image, before, self._visible, *self._tiles, SATURATED_GREY, sums)
        return sums


def borders(pixels: int, tiles: int) -> NDArray[np.int32]:
    """Return the first pixel of each tile along a side, and the end (tiles + 1,)."""
    return np.rint(np.arange(tiles + 1) * pixels / tiles).astype(np.int32)
