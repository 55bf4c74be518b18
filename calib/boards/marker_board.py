"""Boards whose corners are identified by markers, so that any visible part of them counts.

ChArUco boards are checkerboards with a marker in every light square. AprilTag grids are printed by Kalibr: the tags'
borders are two bits wide, and black squares between the tags turn the tags' corners into corners of a checkerboard.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import MAX_SIDE, MAX_SQUARE_M, MIN_SQUARE_M, grid_points
from calib.errors import CalibError
from calib.models.camera import Array

Dictionary = cv2.aruco.Dictionary
# The predefined dictionaries of OpenCV by name, like 5X5_100 and APRILTAG_36h11.
DICTIONARIES = {
    name.removeprefix("DICT_"): int(getattr(cv2.aruco, name)) for name in dir(cv2.aruco) if name.startswith("DICT_")
}
# Least part of a square that a marker fills, and largest, because a light margin has to remain.
MIN_MARKER_PART, MAX_MARKER_PART = 0.3, 0.95
# Least and largest space between two tags, in parts of a tag.
MIN_SPACING, MAX_SPACING = 0.05, 1.0
# Tags as in Kalibr: family, width of the border [bits], bits along a side within the border.
TAG_FAMILY, TAG_BORDER_BITS, TAG_BITS = "APRILTAG_36h11", 2, 6
# Tag 0 of the family 36h11 (Olson 2011): row by row, the most significant bit at the upper left, 1 is light.
TAG_0 = 0xD5D628584


@dataclass(frozen=True, slots=True)
class MarkerLayout:
    """Markers of a board: ids (M,), and the corners (M, 4, 2) [m] in the order of cv2.aruco."""

    dictionary: Dictionary
    border_bits: int
    ids: NDArray[np.int64]
    corners: Array


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A checkerboard of columns x rows inner corners, one square_m apart, with markers of marker_m in light squares.

    dictionary: name in DICTIONARIES. legacy: drawn by OpenCV before 4.6, which differs for an odd number of rows.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        _check_sides("charuco", (self.columns, self.rows), 2, "inner corners")
        _check_length("squares", self.square_m)
        if not MIN_MARKER_PART <= self.marker_m / self.square_m <= MAX_MARKER_PART:
            raise CalibError(
                f"board: expected markers of {MIN_MARKER_PART:g} to {MAX_MARKER_PART:g} of the squares' "
                f"side, found {1e3 * self.marker_m:g} mm in squares of {1e3 * self.square_m:g} mm"
            )
        _check_capacity(self.dictionary, len(self._board().getIds()))

    @property
    def points(self) -> Array:
        """Return the inner corners (N, 3) [m], row by row from the first one, z 0."""
        return grid_points(self.columns, self.rows, self.square_m)

    @property
    def window(self) -> float:
        """Return the half side, in squares, of a window about a corner that no marker touches."""
        return (1 - self.marker_m / self.square_m) / 2

    @property
    def markers(self) -> MarkerLayout:
        """Return the markers."""
        board = self._board()
        # OpenCV's frame has its origin at the print's corner, a square before the first inner corner.
        corners = np.asarray(board.getObjPoints(), float).reshape(-1, 4, 3)[..., :2] - self.square_m
        return MarkerLayout(board.getDictionary(), 1, np.asarray(board.getIds(), np.int64).ravel(), corners)

    def __str__(self) -> str:
        return f"ChArUco board of {self.columns}x{self.rows} inner corners with markers {self.dictionary}"

    def _board(self) -> cv2.aruco.CharucoBoard:
        size = (self.columns + 1, self.rows + 1)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, predefined(self.dictionary))
        board.setLegacyPattern(self.legacy)
        return board


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
        _check_sides("aprilgrid", (self.columns, self.rows), 1, "tags")
        _check_length("tags", self.tag_m)
        if not MIN_SPACING <= self.spacing <= MAX_SPACING:
            raise CalibError(
                f"board: expected a space between tags of {MIN_SPACING:g} to {MAX_SPACING:g} of a tag's "
                f"side, like Kalibr's tagSpacing, found {self.spacing:g}"
            )
        _check_capacity(TAG_FAMILY, self.columns * self.rows)

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
    def markers(self) -> MarkerLayout:
        """Return the tags."""
        y, x = np.divmod(np.arange(self.columns * self.rows), self.columns)
        # Clockwise from the upper left of the tag as Kalibr prints it, then from that of OpenCV's dictionary.
        corner = np.roll(np.array([[0, 1], [1, 1], [1, 0], [0, 0]]), _quarter_turns(), axis=0)
        first = np.column_stack([x, y])[:, None] * (1 + self.spacing)
        return MarkerLayout(predefined(TAG_FAMILY), TAG_BORDER_BITS, np.arange(len(x)), (first + corner) * self.tag_m)

    def __str__(self) -> str:
        return f"AprilTag grid of {self.columns}x{self.rows} tags"

    def _ends(self, tags: int) -> Array:
        return np.asarray((np.arange(tags)[:, None] * (1 + self.spacing) + [0, 1]).ravel())


MarkerBoard = CharucoBoard | AprilGrid


def predefined(name: str) -> Dictionary:
    """Return OpenCV's dictionary of that name; CalibError if there is none."""
    if name not in DICTIONARIES:
        raise CalibError(f"board: expected a dictionary of markers ({', '.join(sorted(DICTIONARIES))}), found {name!r}")
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])


@lru_cache(maxsize=1)
def _quarter_turns() -> int:
    """Return the counter-clockwise quarter turns from OpenCV's tags to the family's."""
    image = cv2.aruco.generateImageMarker(predefined(TAG_FAMILY), 0, TAG_BITS + 2, borderBits=1)[1:-1, 1:-1] > 0
    bits = np.array([TAG_0 >> k & 1 for k in range(TAG_BITS**2 - 1, -1, -1)], bool).reshape(TAG_BITS, TAG_BITS)
    return next(k for k in range(4) if (np.rot90(image, k) == bits).all())


def _check_sides(kind: str, sides: tuple[int, int], least: int, what: str) -> None:
    if not all(least <= side <= MAX_SIDE for side in sides):
        raise CalibError(f"board: expected {least} to {MAX_SIDE} {what} a side for {kind}, found {sides[0]}x{sides[1]}")


def _check_length(what: str, length_m: float) -> None:
    if not MIN_SQUARE_M <= length_m <= MAX_SQUARE_M:
        raise CalibError(f"board: expected {what} of 0.1 mm to 10 m, found {length_m * 1e3:g} mm")


def _check_capacity(name: str, markers: int) -> None:
    capacity = len(predefined(name).bytesList)
    if markers > capacity:
        raise CalibError(
            f"board: {name} has {capacity} markers, and this board needs {markers}; check the numbers of "
            "corners or tags, and the dictionary"
        )
