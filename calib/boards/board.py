"""A checkerboard and a grid of AprilTags, and the shape of its print.

Paper curls, a plate gives way, a printer stretches one side. The drawing's points lie in a plane. A print differs from
it to second order: out of the plane by a quadratic surface, in the plane by the ratio of its sides. mrcal models the
first by two parabolas along the sides ("calobject_warp"); the third term, the twist, holds a board that curls about its
diagonal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array

# Inner corners along one side: fewer do not determine a pose well, more are a misread option.
MIN_SIDE, MAX_SIDE = 3, 60
# Half side of the window about a checkerboard's corner [squares], less than a half, so that neighbours share no pixel.
WINDOW = 0.42
# Tags as in Kalibr: number of those of the family 36h11, width of the border [bits], bits along a side within it.
TAGS, TAG_BORDER_BITS, TAG_BITS = 587, 2, 6


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
        if not 0 < self.square_m < math.inf:
            raise CalibError(f"board: expected squares of a length above 0, found {self.square_m * 1e3:g} mm")

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
class AprilGrid:
    """A grid of columns x rows AprilTags 36h11 of tag_m, spacing times tag_m apart, as Kalibr prints it.

    The numbers of the tags rise along x, then along y, from 0. Kalibr's frame: x right, y up, origin at the lower left
    corner of tag 0.
    """

    columns: int
    rows: int
    tag_m: float
    spacing: float

    def __post_init__(self) -> None:
        if not 1 <= self.columns * self.rows <= TAGS:
            raise CalibError(
                f"board: expected 1 to {TAGS} tags, as the family 36h11 has, found {self.columns}x{self.rows}"
            )
        if not 0 < self.tag_m < math.inf:
            raise CalibError(f"board: expected tags of a length above 0, found {self.tag_m * 1e3:g} mm")
        if not 0 < self.spacing <= 1:
            raise CalibError(
                "board: expected a space between tags of at most a tag's side, like Kalibr's tagSpacing, found "
                f"{self.spacing:g}"
            )

    @property
    def square_m(self) -> float:
        """Return the side of a tag [m], the unit of the windows about corners."""
        return self.tag_m

    @property
    def points(self) -> Array:
        """Return the corners of all tags (N, 3) [m], row by row upwards, z 0."""
        x, y = np.meshgrid(self._ends(self.columns), self._ends(self.rows))
        return np.asarray(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * self.tag_m)

    @property
    def window(self) -> float:
        """Return the half side, in tags, of a window about a tag's corner: its border, the square beside it."""
        return min(self.spacing, TAG_BORDER_BITS / (TAG_BITS + 2 * TAG_BORDER_BITS))

    @property
    def tag_corners(self) -> Array:
        """Return the corners (M, 4, 2) [m] of the tags in the order of cv2.aruco."""
        y, x = np.divmod(np.arange(self.columns * self.rows), self.columns)
        # Clockwise from the upper left of the tag in OpenCV's dictionary, which is turned by half a turn as Kalibr
        # prints it.
        corner = np.array([[1, 0], [0, 0], [0, 1], [1, 1]])
        return np.asarray((np.column_stack([x, y])[:, None] * (1 + self.spacing) + corner) * self.tag_m)

    def __str__(self) -> str:
        return f"AprilTag grid of {self.columns}x{self.rows} tags"

    def _ends(self, tags: int) -> Array:
        return np.asarray((np.arange(tags)[:, None] * (1 + self.spacing) + [0, 1]).ravel())


AnyBoard: TypeAlias = Board | AprilGrid


MODE_NAMES = ("bend_x", "bend_y", "twist", "stretch")
# Standard deviations of the modes of usual prints, the prior of a fit, and one step of each [m, m, m, ratio].
MODE_SIGMAS = np.array([1e-3, 1e-3, 1e-3, 2e-3])


@dataclass(frozen=True, slots=True)
class PrintShape:
    """Difference of a print from its drawing.

    With u, v from -1 to 1 along the sides x and y of the corners, points are higher by bend_x (1 - u^2) + bend_y
    (1 - v^2) + twist u v [m]. Lengths along y are longer by the fraction stretch / 2, those along x shorter.
    """

    values: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # in the order of MODE_NAMES

    @property
    def stretch(self) -> float:
        """Return the fraction by which lengths along y are longer than those along x."""
        return self.values[3]

    def points(self, drawn: Array) -> Array:
        """Return the print's corners (N, 3) [m] of those of the drawing (N, 3), z 0.

        A sheet that bends keeps its lengths: points move inwards by the integral of half its squared slope.
        """
        uv, half = _sides(drawn)
        moved = drawn + all_modes(drawn) @ (np.array(self.values) / MODE_SIGMAS)
        moved[:, :2] -= 2 / 3 * np.array(self.values[:2]) ** 2 * uv**3 / half
        return np.asarray(moved)

    def moved(self, steps: Array) -> PrintShape:
        """Return the shape after steps (4,) of its modes."""
        bend_x, bend_y, twist, stretch = (np.array(self.values) + steps * MODE_SIGMAS).tolist()
        return PrintShape((bend_x, bend_y, twist, stretch))

    def described(self, drawn: Array) -> str:
        """Return the difference of the print from its drawing (N, 3) in one line."""
        # The bend is the range of the heights over the corners, above the plane that fits them best.
        heights, plane = self.points(drawn)[:, 2], np.column_stack([drawn[:, :2], np.ones(len(drawn))])
        sag_m = float(np.ptp(heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]))
        longer, other = ("y (down the rows)", "x") if self.stretch > 0 else ("x (along the columns)", "y")
        return (
            f"the board is bent by {1e3 * sag_m:.2g} mm, and its print {100 * abs(self.stretch):.2g} % "
            f"longer along {longer} than along {other}, which the calibration allows for"
        )


AS_DRAWN = PrintShape()


def all_modes(drawn: Array) -> Array:
    """Return the moves (N, 3, 4) [m] of a drawing's corners (N, 3) by one step of every mode."""
    uv, half = _sides(drawn)
    moves = np.zeros((len(uv), 3, len(MODE_NAMES)))
    moves[:, 2, :3] = np.column_stack([1 - uv**2, uv[:, :1] * uv[:, 1:]])
    moves[:, :2, 3] = uv * half * (-0.5, 0.5)
    return np.asarray(moves * MODE_SIGMAS)


def _sides(drawn: Array) -> tuple[Array, Array]:
    """Return the places u, v (N, 2) of a board's corners, from -1 to 1 along its sides, and half the sides (2,) [m]."""
    low, high = drawn[:, :2].min(axis=0), drawn[:, :2].max(axis=0)
    half = (high - low) / 2
    return (drawn[:, :2] - (low + high) / 2) / half, half
