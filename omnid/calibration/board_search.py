"""Search for boards in a camera's images, with progress lines."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from calib.boards.board import Board, BoardView
from calib.boards.board_finder import BoardSearch, find_board
from omnid.calibration.images import Image, Images
from omnid.errors import OmnidError


def find_boards(images: Images, board: Board, *, thorough: bool, show_progress: bool) -> list[BoardView]:
    """Find the views of a board in images, on all cores; raises OmnidError if there is none, naming other grids."""
    views, other_grids = list[BoardView](), Counter[tuple[int, int]]()

    def search_of(named: tuple[str, Image]) -> tuple[str, BoardSearch]:
        return named[0], find_board(named[1], board, named[0], thorough=thorough)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for number, (name, search) in enumerate(pool.map(search_of, images.items()), 1):
            if search.view is not None:
                views.append(search.view)
            if search.grid_size != (0, 0):
                other_grids[_sorted(search.grid_size)] += 1
            if show_progress:
                print(f"[{number}/{len(images)}] {name}: {_progress(search)}", file=sys.stderr)
    if not views:
        raise OmnidError(_none_found(len(images), board, other_grids))
    return views


def _sorted(sides: tuple[int, int]) -> tuple[int, int]:
    return min(sides), max(sides)


def _progress(search: BoardSearch) -> str:
    if search.view is not None:
        return f"board found, confidence {search.view.confidence:.2f}"
    columns, rows = search.grid_size
    return f"no board, but a grid of {columns}x{rows}" if columns else "no board"


def _none_found(images: int, board: Board, other_grids: Counter[tuple[int, int]]) -> str:
    hint = "count the inner corners, and take images with the whole board in view, sharp and well lit"
    if other_grids:
        (columns, rows), times = other_grids.most_common(1)[0]
        hint = f"a grid of {columns}x{rows} was found in {times}: try --corners {columns}x{rows}"
    return f"calibrate: no board of {board.columns}x{board.rows} inner corners in any of {images} images; {hint}"


def select_diverse_views(views: Sequence[BoardView], count: int) -> list[BoardView]:
    """Select at most count views whose first and last corners are far apart (farthest point sampling)."""
    corners = np.nan_to_num(np.array([view.pixels[[0, -1]].ravel() for view in views]))
    chosen = [0]
    distance = np.full(len(views), np.inf)
    while len(chosen) < min(count, len(views)):
        distance = np.minimum(distance, np.linalg.norm(corners - corners[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return [views[index] for index in sorted(set(chosen))]
