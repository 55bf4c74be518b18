"""`omnid calibrate board`: a board to print, true to scale."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from omnid.calibration.printable_board import PAPERS_MM
from omnid.commands.board_options import BOARD, board_of, options_of
from omnid.commands.options import command, option
from omnid.errors import OmnidError


@command(
    BOARD,
    option("--paper", choices=sorted(PAPERS_MM), default="a4", help="default %(default)s, either way round"),
    option("-o", "--output", type=Path, required=True, metavar="FILE.pdf"),
    examples=(
        "calibrate board --corners 6x7 --square-mm 25 -o board.pdf",
        "calibrate board --board charuco --corners 5x7 --square-mm 30 --marker-mm 22 --dictionary 5X5_100 -o board.pdf",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Write the PDF."""
    from calib.boards.board_pose import ambiguous_orders
    from omnid.calibration.printable_board import board_pdf

    board, options = board_of(args), shlex.join(options_of(args))
    if len(ambiguous_orders(board)) > 1:
        columns, rows = args.corners
        raise OmnidError(
            f"--corners {columns}x{rows}: such a board looks the same when it is turned: give one even "
            f"and one odd number, such as {columns}x{rows + 1}"
        )
    args.output.write_bytes(board_pdf(board, args.paper, options))
    print(
        f"{args.output}: {board}; print it at 100 % on {args.paper}, measure the line of 100 mm, then: "
        f"omnid calibrate rig LOG {options} -o rig.toml"
    )
    return 0
