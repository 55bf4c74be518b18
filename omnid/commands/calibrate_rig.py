"""`omnid calibrate rig`: calibrate a rig by simultaneous images of a board."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from omnid.calibration.board_search import silent
from omnid.calibration.rig import calibrate_rig
from omnid.calibration.view_guess import VIEW_CHOICES, VIEW_HELP
from omnid.commands.calibrate_options import BOARD, HEIGHT, board_of, height_of, with_height
from omnid.commands.options import BITS, LOG_TIME, RATE, cameras, command, log_cameras, option
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs


@command(
    option(
        "images",
        type=Path,
        metavar="LOG|DIR",
        help="a log of both cameras, or a folder with lower_*.png, upper_*.png of the same names",
    ),
    BOARD,
    option(
        "--expected-baseline-mm",
        type=float,
        metavar="MM",
        help="the measured distance of the mirrors: a result that differs by more than a tenth is refused",
    ),
    *cameras("a log's topic of the {camera} camera"),
    BITS,
    LOG_TIME,
    RATE,
    option("--view", choices=VIEW_CHOICES, default="auto", help=VIEW_HELP),
    option("--report", type=Path, metavar="FILE", help="write an HTML report with residuals and panoramas"),
    HEIGHT,
    option("--quiet", action="store_true", help="no progress"),
    option("-o", "--output", type=Path, required=True, help="the rig.toml to write"),
    examples=(
        "calibrate rig boards.mcap --corners 6x7 --square-mm 30 -o rig.toml",
        "calibrate rig DIR --board aprilgrid --tags 6x6 --tag-mm 88 --tag-spacing 0.3 -o rig.toml",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Calibrate the rig, write the files, and print the warnings on stderr and the result as one line.

    Return 1 where more than a tenth of a log's images made no pair.
    """
    board = board_of(args)
    named = [("--output", args.output), ("--report", args.report)]
    read = [("a file that is read", args.images)]
    check_outputs([(name, path) for name, path in named if path is not None], read)
    expected_mm = args.expected_baseline_mm
    if expected_mm is not None and not expected_mm > 0:
        raise OmnidError(f"--expected-baseline-mm {expected_mm:g}: expected a length above 0")
    found = calibrate_rig(
        args.images,
        board,
        topics=log_cameras(args),
        view=args.view,
        expected_baseline_m=None if expected_mm is None else expected_mm / 1e3,
        progress=silent if args.quiet else lambda line: print(line, file=sys.stderr),
    )
    found = replace(found, rig=with_height(found.rig, args))
    found.save(args.output)
    if args.report:
        found.save_report(args.report)
    for line in found.warnings:
        print(f"warning: {line}", file=sys.stderr)
    for line in found.tables:
        print(line)
    print(f"{args.output}: {found}")
    print(f"{args.output}: {height_of(found.rig)}")
    return int(bool(found.images.loss))
