"""Search for boards in all images of a camera."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from calib.boards.aprilgrid import find_april_grid
from calib.boards.board import AnyBoard, AprilGrid, Board
from calib.boards.checkerboard import find_board
from calib.models.camera import Array
from calib.models.ocam import View
from calib.validation import LineReporter
from omnid.calibration.images import Image, Images
from omnid.errors import OmnidError


def require_one_orientation(board: AnyBoard) -> None:
    """Raise OmnidError for a checkerboard of which two cameras may not see the same side up."""
    if isinstance(board, Board) and (board.columns + board.rows) % 2 == 0:
        raise OmnidError(
            f"calibrate: a {board} looks the same upside down: take one with an odd and an even number of corners"
        )


def search_board(image: Image, board: AnyBoard) -> Array | None:
    """Return pixels (N, 2) of the corners of a board of any kind in an image, NaN for unknown ones; None: no board."""
    return find_board(image, board) if isinstance(board, Board) else find_april_grid(image, board)


def find_boards(camera: str, images: Images, board: AnyBoard, progress: LineReporter) -> dict[str, Array]:
    """Return the corners (N, 2) [px] by the names of the images that show a board; OmnidError if there is none."""
    views = dict[str, Array]()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        searches = pool.map(lambda image: search_board(image, board), images.values())
        for number, (name, view) in enumerate(zip(images, searches, strict=True), 1):
            outcome = "no board"
            if view is not None:
                views[name] = view
                outcome = f"board found, {np.isfinite(view[:, 0]).sum()} of {len(view)} corners"
            progress(f"[{number}/{len(images)}] {camera} camera, {name}: {outcome}")
    if not views:
        raise OmnidError(
            f"calibrate: no {board} in any of {len(images)} images of the {camera} camera; check the options of the "
            "board, and take images with the whole board in view, near, sharp and well lit"
        )
    return views


def view_of_tags(stated: View | None, views: Sequence[Array], board: AprilGrid) -> View:
    """Return the view of cameras that the tags of a grid show; OmnidError where another one is stated."""
    # The grid's y points up in an image that is not reflected, the pixels' v down.
    reflected = []
    for view in views:
        seen = np.isfinite(view[:, 0])
        known = np.column_stack([board.points[seen, :2], np.ones(seen.sum())])
        affine = np.linalg.lstsq(known, view[seen], rcond=None)[0]
        reflected.append(np.linalg.det(affine[:2]) > 0)
    found: View = "mirror" if np.mean(reflected) > 0.5 else "direct"
    if stated not in (None, found):
        raise OmnidError(f"calibrate: the view is given as {stated}, but the tags show it as {found}: leave --view out")
    return found
