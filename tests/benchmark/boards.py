"""Boards in hard renderings, against OpenCV's detectors: `python -m tests.benchmark.boards [--seed 1] [--count 50]`.

A board counts as found where all its corners lie on the true ones, and as wrong where one does not: that spoils a
calibration in silence. omnid has to look at the same places without the board as well,
where any is wrong.
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
from tests.benchmark.boards_rendered import Hard, hard

# A corner is right within this part of its square's narrower side, or a pixel: half a side off is the next edge.
RIGHT_PART, RIGHT_PX = 0.25, 1.0
Image = NDArray[np.uint8]
Detect = Callable[[Image, Board], Array | None]  # corners (N, 2) [px], NaN where hidden


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


DETECTORS: dict[str, Detect] = {"omnid": _ours, "findChessboardCorners": _plain, "findChessboardCornersSB": _sector}


def judged(found: Array | None, shot: Hard) -> str:
    """found, wrong or missed."""
    if found is None:
        return "missed"
    truth = shot.corners.reshape(shot.board.rows, shot.board.columns, 2)
    sides = [np.linalg.norm(np.diff(truth, axis=axis), axis=2).min() for axis in (0, 1)]
    off = min(float(np.nanmax(np.linalg.norm(found - way, axis=1))) for way in _ways(truth, shot.board))
    return "found" if off < max(RIGHT_PX, RIGHT_PART * min(sides)) else "wrong"


def _ways(truth: Array, board: Board) -> list[Array]:
    """The truth (N, 2) in every order a detector may give a board in, flipped or turned."""
    flipped = [truth, truth[::-1], truth[:, ::-1], truth[::-1, ::-1]]
    return [way.reshape(-1, 2) for way in (*flipped, *(way.swapaxes(0, 1) for way in flipped * (board.columns
                                                                                              == board.rows)))]


def count(shots: Sequence[Hard], detect: Detect, *, empty: bool = True) -> Counter[str]:
    """How many boards a detector found, missed and got wrong."""
    counts = Counter(judged(detect(shot.image, shot.board), shot) for shot in shots)
    counts["wrong"] += sum(detect(shot.empty, shot.board) is not None for shot in shots) if empty else 0
    return counts


def main(arguments: list[str]) -> int:
    """Prints what each detector makes of every image, and the sums; 1 where a board was wrong or too few found."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmark.boards", description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first image")
    parser.add_argument("--count", type=int, default=50)
    args = parser.parse_args(arguments)
    sums = {name: Counter[str]() for name in DETECTORS}
    for number in range(args.first, args.first + args.count):
        shot = hard(args.seed, number)
        verdicts = {name: count([shot], detect, empty=name == "omnid") for name, detect in DETECTORS.items()}
        for name, verdict in verdicts.items():
            sums[name] += verdict
        print(f"{shot.name}: {', '.join(f'{name} {_said(verdict)}' for name, verdict in verdicts.items())}", flush=True)
    for name, all_of in sums.items():
        print(f"{name}: " + ", ".join(f"{all_of[kind]} {kind}" for kind in ("found", "wrong", "missed")))
    return 0 if enough(sums, args.count) else 1


def _said(verdict: Counter[str]) -> str:
    return "/".join(kind for kind in ("found", "missed", "wrong") if verdict[kind])


def enough(sums: dict[str, Counter[str]], images: int) -> bool:
    """No wrong board, and as many as OpenCV's best detector finds and half of what it misses."""
    best = max(sums[name]["found"] for name in DETECTORS if name != "omnid")
    return sums["omnid"]["wrong"] == 0 and sums["omnid"]["found"] >= best + (images - best) / 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
