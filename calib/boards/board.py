"""A checkerboard and its view in one image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array

# Inner corners along one side: fewer do not determine a pose well, more are a misread option.
MIN_SIDE, MAX_SIDE = 3, 60
# Squares beyond these are refused, because they are lengths in another unit.
MIN_SQUARE_M, MAX_SQUARE_M = 1e-4, 10.0
# Half side of the window about a checkerboard's corner [squares], less than a half, so that neighbours share no pixel.
WINDOW = 0.42


class CalibrationBoard(Protocol):
    """A flat board with corners at known points, at which four areas of alternating brightness meet."""

    @property
    def points(self) -> Array:
        """Return the corners (N, 3) [m] in the board's frame, z 0."""

    @property
    def square_m(self) -> float:
        """Return the unit of length [m] of windows about corners: the side of a square or a tag."""

    @property
    def window(self) -> float:
        """Return the half side [squares] of the window about a corner in which grey depends on that corner alone."""


@dataclass(frozen=True, slots=True)
class Board:
    """A flat checkerboard of columns x rows inner corners, one square_m apart."""

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if not all(MIN_SIDE <= side <= MAX_SIDE for side in (self.columns, self.rows)):
            raise CalibError(
                f"board: expected {MIN_SIDE} to {MAX_SIDE} inner corners a side, found "
                f"{self.columns}x{self.rows}; count the points where four squares meet, not the squares"
            )
        if not MIN_SQUARE_M <= self.square_m <= MAX_SQUARE_M:
            raise CalibError(f"board: expected squares of 0.1 mm to 10 m, found {self.square_m * 1e3:g} mm")

    @property
    def points(self) -> Array:
        """Return the corners (N, 3) [m] in the board's frame, row by row: x along the columns, y down the rows, z 0."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.asarray(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.square_m, float)

    @property
    def window(self) -> float:
        """Return the half side of the window about a corner [squares]."""
        return WINDOW

    def __str__(self) -> str:
        return f"board of {self.columns}x{self.rows} inner corners"


@dataclass(frozen=True, slots=True)
class BoardView:
    """The corners of a board in one image: pixels (N, 2) in the order of Board.points, NaN for unknown corners.

    confidence 0 to 1: share of accepted corners times the regularity of the grid. The board's x and y axes turn
    clockwise in the image. The first square is dark where the board's sides (one even, one odd) determine it.
    """

    name: str
    pixels: Array
    confidence: float = 1.0
