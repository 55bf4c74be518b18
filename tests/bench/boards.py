"""Board detection in hard renderings, compared with OpenCV: `python -m tests.bench.boards [--seed 1] [--count 50]`.

`--near`: near, large and slanted boards in wide-angle lenses, some with a frame that covers their edge.

A board is found if all its corners are near the true ones, and wrong if one is not: a wrong board corrupts a
calibration without notice. omnid's detector is also applied to the same scenes without the board, where every detection
is wrong.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.boards.board import Board
from calib.boards.board_finder import find_board
from calib.models.camera import Array
from tests.bench.boards_near import render_near_board
from tests.bench.boards_rendered import HardBoard, render_hard_board
from tests.bench.results import Column, ResultTable

# Tolerance of a corner in parts of its square's narrower side, or in pixels; the next edge is half a side away.
RIGHT_PART, RIGHT_PX = 0.25, 1.0
Image = NDArray[np.uint8]
# Returns corners (N, 2) [px], NaN if hidden.
Detect = Callable[[Image, Board], Array | None]


def _ours(image: Image, board: Board) -> Array | None:
    view = find_board(image, board).view
    return None if view is None else view.pixels


def _plain(image: Image, board: Board) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    return _corners(*cv2.findChessboardCorners(image, (board.columns, board.rows), flags=flags))


def _sector(image: Image, board: Board) -> Array | None:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    return _corners(*cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags))


def _corners(found: bool, corners: Array | None) -> Array | None:
    return np.asarray(corners, float).reshape(-1, 2) if found and corners is not None else None


REMARKS = ("Wrong counts, for omnid only, also each board that is found where there is none.",)
DETECTORS: dict[str, Detect] = {"omnid": _ours, "findChessboardCorners": _plain, "findChessboardCornersSB": _sector}


def classify_detection(found: Array | None, rendered: HardBoard) -> str:
    """Return found, wrong or missed."""
    if found is None:
        return "missed"
    truth = rendered.corners.reshape(rendered.board.rows, rendered.board.columns, 2)
    sides = [np.linalg.norm(np.diff(truth, axis=axis), axis=2).min() for axis in (0, 1)]
    orders = corner_orders(truth, rendered.board)
    off = min(float(np.nanmax(np.linalg.norm(found - order, axis=1))) for order in orders)
    return "found" if off < max(RIGHT_PX, RIGHT_PART * min(sides)) else "wrong"


def corner_orders(truth: Array, board: Board) -> list[Array]:
    """Return the truth (N, 2) in every order that a detector may return, flipped or rotated."""
    orders = [truth, truth[::-1], truth[:, ::-1], truth[::-1, ::-1]]
    if board.columns == board.rows:
        orders += [order.swapaxes(0, 1) for order in orders]
    return [order.reshape(-1, 2) for order in orders]


def count(shots: Sequence[HardBoard], detect: Detect, *, empty: bool = True) -> Counter[str]:
    """Count the boards that a detector found, missed and got wrong."""
    counts = Counter(classify_detection(detect(rendered.image, rendered.board), rendered) for rendered in shots)
    counts["wrong"] += sum(detect(rendered.empty, rendered.board) is not None for rendered in shots) if empty else 0
    return counts


def main(arguments: list[str]) -> int:
    """Print the outcome of each detector for every image, and the sums; 1 if a board is wrong or too few are found."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.boards", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first image")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--near", action="store_true", help="boards near a wide-angle lens")
    args = parser.parse_args(arguments)
    render = render_near_board if args.near else render_hard_board
    sums = {name: Counter[str]() for name in DETECTORS}
    for number in range(args.first, args.first + args.count):
        rendered = render(args.seed, number)
        outcomes_of = {name: count([rendered], detect, empty=name == "omnid") for name, detect in DETECTORS.items()}
        for name, found in outcomes_of.items():
            sums[name] += found
        outcomes = ", ".join(f"{name} {_outcomes(found)}" for name, found in outcomes_of.items())
        print(f"{rendered.name}: {outcomes}", flush=True)
    kinds, family = ("found", "wrong", "missed"), f"boards, {'near' if args.near else 'hard'}"
    table = ResultTable(
        family.replace(", ", "_"),
        "calibration",
        f"Board detection, {'near' if args.near else 'hard'}",
        (Column("detector"), Column("images"), *map(Column, kinds)),
        REMARKS,
    )
    for name, all_of in sums.items():
        table.add(name, args.count, *(all_of[kind] for kind in kinds), seed=(family, args.seed))
    return 0 if meets_requirement(sums, args.count) else 1


def _outcomes(found: Counter[str]) -> str:
    return "/".join(kind for kind in ("found", "missed", "wrong") if found[kind])


def meets_requirement(sums: dict[str, Counter[str]], images: int) -> bool:
    """True if no board is wrong, and omnid finds as many as OpenCV's best detector and half of what that misses."""
    best = max(sums[name]["found"] for name in DETECTORS if name != "omnid")
    return sums["omnid"]["wrong"] == 0 and sums["omnid"]["found"] >= best + (images - best) / 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
