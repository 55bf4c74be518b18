"""Search for boards in all images of a camera."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, Literal

import numpy as np

from calib.boards.aprilgrid import AprilGrid, find_april_grid
from calib.boards.board import Board, BoardView
from calib.boards.checkerboard import find_board
from calib.models.ocam import VIEWS, View
from calib.rim import find_rim
from calib.validation import silent
from omnid.calibration.images import Image, Images, brightest, middle_px
from omnid.errors import OmnidError

AnyBoard = Board | AprilGrid
Progress = Callable[[str], None]  # receives the lines that a long calibration reports while it runs
# A log shows similar views many times: this number of diverse views is as good as all, in a fraction of the time.
MAX_LOG_VIEWS = 40
CORNERS_HINT = "count the inner corners, and take images with the whole board in view, sharp and well lit"
TAGS_HINT = (
    "check --tags and --tag-spacing, and take images with the board nearer (six pixels a bit of its tags), sharp and "
    "well lit"
)


def search_board(image: Image, board: AnyBoard, name: str = "", *, thorough: bool) -> BoardView | None:
    """Search a board of any kind in an image; name: of the view that is found. thorough: see `find_board`."""
    if isinstance(board, Board):
        return find_board(image, board, name, thorough=thorough)
    return find_april_grid(image, board, name, thorough=thorough)


def find_boards(images: Images, board: AnyBoard, *, thorough: bool, progress: Progress = silent) -> list[BoardView]:
    """Find the views of a board in images, on all cores; raises OmnidError if there is none."""
    views = list[BoardView]()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        searches = pool.map(lambda name: search_board(images[name], board, name, thorough=thorough), images)
        for number, (name, view) in enumerate(zip(images, searches, strict=True), 1):
            outcome = "no board"
            if view is not None:
                views.append(view)
                corners = view.pixels[:, 0]
                outcome = f"board found, {np.isfinite(corners).sum()} of {len(corners)} corners"
            progress(f"[{number}/{len(images)}] {name}: {outcome}")
    if not views:
        hint = CORNERS_HINT if isinstance(board, Board) else TAGS_HINT
        raise OmnidError(f"calibrate: no {board} in any of {len(images)} images; {hint}")
    return views


def select_diverse_views(views: Sequence[BoardView]) -> list[BoardView]:
    """Select at most MAX_LOG_VIEWS whose first and last corners are far apart (farthest point sampling)."""
    corners = np.array([view.pixels[np.flatnonzero(np.isfinite(view.pixels[:, 0]))[[0, -1]]].ravel() for view in views])
    chosen = [0]
    distance = np.full(len(views), np.inf)
    while len(chosen) < min(MAX_LOG_VIEWS, len(views)):
        distance = np.minimum(distance, np.linalg.norm(corners - corners[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return [views[index] for index in sorted(set(chosen))]


ViewChoice = Literal["auto", "mirror", "direct"]
VIEW_CHOICES: Final[tuple[ViewChoice, ...]] = ("auto", *VIEWS)


def view_of_images(
    choice: ViewChoice,
    cameras: Sequence[tuple[Images, Sequence[BoardView]]],
    board: Board | AprilGrid,
    progress: Progress,
) -> tuple[View, list[str]]:
    """Return the chosen view, or the one that the images of a rig's cameras and their views of the board show.

    With it comes a warning where the images show another view than the chosen one: the world would be its mirror image.
    Raises OmnidError for "auto" where the images show no view, or where they contradict each other.
    """
    if choice not in VIEW_CHOICES:
        raise OmnidError(f"view: expected one of {', '.join(VIEW_CHOICES)}, found {choice!r}")
    shown = {found for images, views in cameras if (found := _view_of_camera(images, views, board)) is not None}
    if choice != "auto":
        warning = (
            f"the view is given as {choice}, but the images do not look like that: where it is wrong, left and right "
            "are exchanged in all that follows; leave --view out unless you are sure"
        )
        return choice, [] if shown <= {choice} else [warning]
    if len(shown) != 1:
        words = (
            "a mirror in one and a lens in the other camera" if shown else "no markers and no mirror's rim with a hub"
        )
        raise OmnidError(
            "calibrate: the images do not show whether the world is seen in a mirror or through a lens (found "
            f"{words}): add --view mirror or --view direct"
        )
    (view,) = shown
    progress(f"view: {view}, as the images show")
    return view, []


def _view_of_camera(images: Images, views: Sequence[BoardView], board: Board | AprilGrid) -> View | None:
    """Return the view of one camera by its images and its views of the board; None: undecided."""
    if isinstance(board, Board):
        image = brightest(images.values())
        rim = find_rim(image, middle_px(image))
        return "mirror" if rim is not None and rim.inner_px > 0 else None
    # The grid's y points up in an image that is not reflected, the pixels' v down.
    reflected = []
    for view in views:
        seen = np.isfinite(view.pixels[:, 0])
        known = np.column_stack([board.points[seen, :2], np.ones(seen.sum())])
        affine = np.linalg.lstsq(known, view.pixels[seen], rcond=None)[0]
        reflected.append(np.linalg.det(affine[:2]) > 0)
    if not reflected:
        return None
    return "mirror" if 2 * sum(reflected) > len(reflected) else "direct"
