"""Options of `omnid calibrate`: the board, and the height of the cameras."""

from __future__ import annotations

import argparse
from typing import Final

from calib.boards.aprilgrid import AprilGrid
from calib.boards.board import Board
from calib.rig import Rig
from omnid.calibration.board_search import AnyBoard
from omnid.errors import OmnidError

# Options that each kind of board needs.
NEEDED = {"checkerboard": ("corners", "square_mm"), "aprilgrid": ("tags", "tag_mm", "tag_spacing")}
ALL = tuple(name for names in NEEDED.values() for name in names)


BOARD: Final = """
board:
--board checkerboard|aprilgrid=checkerboard  aprilgrid: Kalibr's AprilTags 36h11, which may be half hidden
--corners 6x7        inner corners (points where four squares meet) along both sides
--square-mm MM       side of one square
--tags 6x6           aprilgrid: tags along x and y (Kalibr's tagCols x tagRows)
--tag-mm MM          aprilgrid: side of one tag (tagSize)
--tag-spacing RATIO  aprilgrid: space between tags in parts of a tag's side, like 0.3 (tagSpacing)
"""


def board_of(args: argparse.Namespace) -> AnyBoard:
    """Return the board that the options describe; OmnidError for missing or unused ones, CalibError for wrong sizes."""
    given = [name for name in ALL if getattr(args, name) is not None]
    needed = NEEDED[args.board]
    missing = [name for name in needed if name not in given]
    if missing:
        raise OmnidError(f"--board {args.board}: expected {_options(needed)}, found no {_options(missing)}")
    unused = [name for name in given if name not in needed]
    if unused:
        raise OmnidError(
            f"--board {args.board}: {_options(unused)} belongs to another kind of board; leave it out, or "
            "choose the --board that was printed"
        )
    if args.board == "aprilgrid":
        columns, rows = args.tags
        return AprilGrid(columns, rows, args.tag_mm / 1e3, args.tag_spacing)
    columns, rows = args.corners
    return Board(columns, rows, args.square_mm / 1e3)


def options_of(args: argparse.Namespace) -> list[str]:
    """Return the options that describe the board, as words of a command line."""
    words = [] if args.board == "checkerboard" else ["--board", args.board]
    for name in NEEDED[args.board]:
        value = getattr(args, name)
        words += [_options([name]), "x".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}"]
    return words


def _options(names: tuple[str, ...] | list[str]) -> str:
    return ", ".join("--" + name.replace("_", "-") for name in names)


def with_height(rig: Rig, args: argparse.Namespace) -> Rig:
    """Return the rig with the height of the option, if it is given."""
    return rig if args.height_m is None else rig.at_height(args.height_m)


def height_of(rig: Rig) -> str:
    """Return the height that a rig states, in words."""
    height_m = rig.height_m()
    return (
        "no height of the cameras (--height-m, or `omnid calibrate drive LOG --only height`)"
        if height_m is None
        else f"cameras {height_m:.3f} m above the floor"
    )
