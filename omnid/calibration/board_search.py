"""The boards in a camera's images, said as they are found."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence

import numpy as np

from calib.boards.board import Board, BoardView
from calib.boards.board_finder import find_board
from omnid.calibration.images import Images
from omnid.errors import OmnidError


def find_boards(images: Images, board: Board, *, thorough: bool, tell: bool) -> list[BoardView]:
    """The views of the board, by the images' names; OmnidError that says what was seen where there is none."""
    views, seen = list[BoardView](), Counter[tuple[int, int]]()
    for number, (name, image) in enumerate(images.items(), 1):
        search = find_board(image, board, name, thorough=thorough)
        if search.view is not None:
            views.append(search.view)
        seen[_sorted(search.seen)] += search.seen != (0, 0)
        said = f"board found, confidence {search.view.confidence:.2f}" if search.view else _no_board(search.seen)
        if tell:
            print(f"[{number}/{len(images)}] {name}: {said}", file=sys.stderr)
    if not views:
        raise OmnidError(_none_found(len(images), board, seen))
    return views


def _sorted(sides: tuple[int, int]) -> tuple[int, int]:
    return min(sides), max(sides)


def _no_board(seen: tuple[int, int]) -> str:
    return f"no board, but a grid of {seen[0]}x{seen[1]}" if seen != (0, 0) else "no board"


def _none_found(images: int, board: Board, seen: Counter[tuple[int, int]]) -> str:
    likely, times = seen.most_common(1)[0] if seen else ((0, 0), 0)
    hint = (f"a grid of {likely[0]}x{likely[1]} was seen in {times}: try --corners {likely[0]}x{likely[1]}" if times
            else "count the inner corners, and take images with the whole board in view, sharp and well lit")
    return f"calibrate: no board of {board.columns}x{board.rows} inner corners in any of {images} images; {hint}"


def spread(views: Sequence[BoardView], count: int) -> list[BoardView]:
    """At most so many views whose corners lie as far as can be from one another's."""
    corners = np.nan_to_num(np.array([view.pixels[[0, -1]].ravel() for view in views]))
    chosen = [0]
    distance = np.full(len(views), np.inf)
    while len(chosen) < min(count, len(views)):
        distance = np.minimum(distance, np.linalg.norm(corners - corners[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return [views[index] for index in sorted(set(chosen))]
