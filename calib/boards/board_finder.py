"""Detection of a checkerboard in a mirror image: by linked corner candidates first, then by OpenCV's detectors.

Corners are linked in the original image, the image with raised local contrast, the enlarged image, and a log-polar
strip about the image's middle. A board is accepted if it has an outline: a ring of squares around its corners, and none
beyond. Where that ring is hidden, two of three detectors have to agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board, BoardView
from calib.boards.board_order import array_to_grid, largest_rectangle, orient_corners, select_board_window
from calib.boards.board_shape import (
    FEW_CORNERS,
    grid_irregularity,
    has_checker_pattern,
    outline,
    prediction_spread,
)
from calib.boards.corner_candidates import BLUR_PX, Grey, describe_corners, find_corners, smoothed
from calib.boards.corner_grid import (
    MIN_RING_PX,
    RING_PART,
    Grid,
    find_grids,
    grow_grid,
    spacing,
    with_clockwise_axes,
)
from calib.boards.corner_refinement import refine_corners
from calib.boards.derived_images import DerivedImage, Image, derived_images
from calib.boards.opencv_boards import are_same, confirmed, grids_nearby, opencv_grids, shared_part
from calib.models.camera import Array

# Shorter side of the smallest image that is searched.
MIN_SIDE_PX = 32
# Number of grids per image that are grown and checked, those closest to the board's corner count.
TRIED_GRIDS = 5
# Largest distance of a corner from where its neighbours predict it, in parts of a square.
MAX_IRREGULARITY = 0.2
# A corner that is farther off than its board's others is one that a shadow or a cover moves, by judgement: in parts of
# the median, where the prediction's own spread is taken out, and least distance in parts of a square.
MAX_OUTLIER, MIN_OUTLIER = 4.0, 0.015
# Least share of accepted corners in a detected board.
MIN_GOOD = 0.75
# Number of boards without an outline that OpenCV is asked to confirm in one image.
MAX_UNCONFIRMED = 2
# Least share of the board's corners in a grid around which OpenCV searches once more.
PARTIAL = 0.6
# Least share of corners accepted of a board without outline that one detector alone finds.
MIN_LONE_PART = 0.9
# Larger grids are not grown: in parts of the board's corners, and at least.
FLOOR_PART, MIN_FLOOR_CORNERS = 3, 200
# A grid that shares more than this part of its corners with a floor belongs to it.
MAX_SHARED = 0.5
# A smaller grid is not reported as a board of another size, because bricks and letters form a few squares by chance.
MIN_HINT_CORNERS = 12
MIN_HINT_SIDE = 3


@dataclass(frozen=True, slots=True)
class BoardSearch:
    """The result for one image: the board's view, or the size (columns, rows) of another grid, (0, 0) for none."""

    view: BoardView | None
    grid_size: tuple[int, int] = (0, 0)


@dataclass(frozen=True, slots=True)
class _Detection:
    """A board's corners (rows, columns, 2), NaN for those not accepted, and the squares around them.

    is_complete: a ring of squares surrounds the corners, and none follows; is_bounded: at least none follows.
    """

    corners: Array
    is_complete: bool
    is_bounded: bool

    @property
    def part(self) -> float:
        """Return the share of accepted corners."""
        return float(np.isfinite(self.corners[..., 0]).mean())

    def view(self, name: str) -> BoardView:
        """Return the view of that name."""
        confidence = self.part * (1 - float(np.nanmean(grid_irregularity(self.corners))))
        return BoardView(name, self.corners.reshape(-1, 2), confidence)


def find_board(image: Image, board: Board, name: str = "", *, thorough: bool = True) -> BoardSearch:
    """Find the board in an image (H, W) uint8, its corners refined to a fraction of a pixel.

    thorough=False searches the original image only, about 0.1 s per megapixel: for logs with many frames.
    """
    if min(image.shape) < MIN_SIDE_PX:
        return BoardSearch(None)
    largest, partial, unconfirmed, floors = (0, 0), Grid(), list[Grid](), list[Grid]()
    blurred = smoothed(image, BLUR_PX)
    for searched in derived_images(image) if thorough else islice(derived_images(image), 1):
        grids = [grow_grid(blurred, candidate, _most_corners(board)) for candidate in _grids(searched, board)]
        floors += [grid for grid in grids if _is_floor(grid, board)]
        for grid in grids:
            found = _detection(image, blurred, grid, floors, board)
            if found is not None and (
                found.is_complete or (thorough and _is_confirmed(image, found, board, unconfirmed))
            ):
                return BoardSearch(found.view(name))
            partial = max(partial, grid, key=lambda one: _likeness(one, board))
            largest = max(largest, largest_rectangle(grid), key=lambda sides: sides[0] * sides[1])
    view = _opencv_view(image, blurred, board, partial, floors, name) if thorough else None
    is_hint = view is None and min(largest) >= MIN_HINT_SIDE and largest[0] * largest[1] >= MIN_HINT_CORNERS
    return BoardSearch(view, largest if is_hint else (0, 0))


def _is_confirmed(image: Image, found: _Detection, board: Board, unconfirmed: list[Grid]) -> bool:
    """True if OpenCV finds a board without an outline as well; it is added to the unconfirmed ones otherwise."""
    shown = array_to_grid(found.corners)
    if not found.is_bounded or len(unconfirmed) == MAX_UNCONFIRMED or any(are_same(shown, one) for one in unconfirmed):
        return False
    unconfirmed.append(shown)
    return confirmed(image, found.corners, board)


def _likeness(grid: Grid, board: Board) -> float:
    """Return how near the number of corners of a grid is to the board's; 0 if far from it."""
    part = len(grid) / (board.columns * board.rows)
    return min(part, 1 / part) if PARTIAL < part < 1 / PARTIAL else 0.0


def _opencv_view(
    image: Image, blurred: Grey, board: Board, partial: Grid, floors: list[Grid], name: str
) -> BoardView | None:
    """Return the view of the board that OpenCV's detectors find, at last around a partial grid of it.

    A board without an outline is accepted if two find it, or if one does and it has many corners, all of them good.
    """
    detected = list[Grid]()
    nearby = grids_nearby(image, partial, board) if _likeness(partial, board) else ()
    for grid in chain(opencv_grids(image, board), nearby):
        found = _detection(image, blurred, grow_grid(blurred, grid, _most_corners(board)), floors, board)
        if found is not None and found.is_complete:
            return found.view(name)
        detected.append(grid)
    for number, grid in enumerate(detected):
        found = _detection(image, blurred, grid, floors, board)
        agree = any(are_same(grid, other) for other in detected[number + 1 :])
        if found is not None and (
            agree or (found.is_bounded and found.part >= MIN_LONE_PART and found.corners.size // 2 >= FEW_CORNERS)
        ):
            return found.view(name)
    return None


def _grids(searched: DerivedImage, board: Board) -> Iterator[Grid]:
    """Yield grids of linked corners in pixels of the source image."""
    blurred = smoothed(searched.image, BLUR_PX)
    corners = find_corners(searched.image)
    for grid in _nearest_in_size(find_grids(blurred, corners), board):
        yield _to_source_pixels(grow_grid(blurred, grid, _most_corners(board)), searched)


def _is_floor(grid: Grid, board: Board) -> bool:
    """True if a grid has more corners than a board with a ring around it, as a frame across its squares makes."""
    return len(grid) > (board.columns + 2) * (board.rows + 2)


def _most_corners(board: Board) -> int:
    """Return the number of corners beyond which a grid is no board: a chequered floor has thousands."""
    return max(MIN_FLOOR_CORNERS, FLOOR_PART * board.columns * board.rows)


def _nearest_in_size(grids: list[Grid], board: Board) -> list[Grid]:
    """Select the grids closest to the board's size, and the largest: it may contain the board or show another count."""
    size = board.columns * board.rows
    near = sorted(grids, key=lambda grid: abs(np.log(len(grid) / size)))[:TRIED_GRIDS]
    return [*near, *(grid for grid in grids[:1] if not any(grid is one for one in near))]


def _to_source_pixels(grid: Grid, searched: DerivedImage) -> Grid:
    """Return the grid in pixels of the source image."""
    pixels = searched.to_source(np.array(list(grid.values())))
    return with_clockwise_axes(dict(zip(grid, pixels, strict=True)))


def _detection(image: Image, blurred: Grey, grid: Grid, floors: list[Grid], board: Board) -> _Detection | None:
    """Return the board in a grid, its corners refined; None if they are too few or the squares no checkerboard.

    Floors are torn where their squares do not fit together, so that a part may look like a board with a few corners too
    many.
    """
    placed = None if floors and len(grid) > board.columns * board.rows else select_board_window(grid, board)
    if placed is None or any(shared_part(array_to_grid(placed), floor) > MAX_SHARED for floor in floors):
        return None
    refined = refine_corners(image, orient_corners(blurred, placed, board))
    good = _without_outliers(blurred, refined)
    if np.isfinite(good[..., 0]).mean() < MIN_GOOD or not has_checker_pattern(blurred, good):
        return None
    return _Detection(good, *outline(blurred, refined))


def _without_outliers(blurred: Grey, corners: Array) -> Array:
    """Return the corners (rows, columns, 2) with NaN for those without a corner's ring or off the regular grid."""
    good = corners.copy()
    good[~_corner_mask(blurred, corners)] = np.nan
    for _ in range(good.shape[0] * good.shape[1]):
        off = grid_irregularity(good)
        score = off / prediction_spread(good)
        usual = float(np.nanmedian(score)) if np.isfinite(score).any() else np.nan
        excess = np.fmax(off / MAX_IRREGULARITY, score / max(MIN_OUTLIER, MAX_OUTLIER * usual))
        worst = np.unravel_index(np.argmax(np.nan_to_num(excess)), excess.shape)
        if not excess[worst] > 1:
            break
        # One at a time: an outlier raises the irregularity of its neighbours.
        good[worst] = np.nan
    return good


def _corner_mask(blurred: Grey, corners: Array) -> NDArray[np.bool_]:
    """Return the mask (rows, columns) of pixels whose ring of grey levels is that of a corner."""
    grid = array_to_grid(corners)
    rings = np.array([max(MIN_RING_PX, RING_PART * spacing(grid, cell)) for cell in grid])
    likely = np.zeros(corners.shape[:2], bool)
    column, row = np.array(list(grid)).T
    likely[row, column] = describe_corners(blurred, np.array(list(grid.values())), rings).quality > 0
    return likely
