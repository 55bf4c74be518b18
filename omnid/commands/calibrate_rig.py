"""`omnid calibrate rig`: calibrate a rig by simultaneous images of a board."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

from omnid.calibration.board_search import silent
from omnid.calibration.rig import calibrate_rig
from omnid.commands.calibrate_options import BOARD, board_of, height_of, with_height
from omnid.commands.options import HEIGHT, LOG_CAMERAS, QUIET, command, log_cameras
from omnid.sinks.files import check_outputs


@command(BOARD, LOG_CAMERAS, HEIGHT, QUIET)
def run(args: argparse.Namespace) -> int:
    """Make a rig.toml from images of a board that both cameras saw at once.

    Warnings go to stderr. Exit code 1: more than a tenth of a log's images made no pair.

    images LOG|DIR    a log of both cameras, or a folder with lower_*.png, upper_*.png of the same names
    -o, --output FILE  the rig.toml to write (required)
    --expected-baseline-mm MM 0.001..  the measured distance of the mirrors: a result that differs by more than a tenth
        is refused
    --view auto|mirror|direct=auto     the world is seen in a mirror or directly through a lens; auto: what markers, or
        rim and hub of a mirror show; else it must be given, as a checkerboard looks the same
    --report FILE     write an HTML report with residuals and panoramas

    examples:
      calibrate rig boards.mcap --corners 6x7 --square-mm 30 -o rig.toml
      calibrate rig DIR --board aprilgrid --tags 6x6 --tag-mm 88 --tag-spacing 0.3 -o rig.toml
    """
    board = board_of(args)
    named = [("--output", args.output), ("--report", args.report)]
    read = [("a file that is read", args.images)]
    check_outputs([(name, path) for name, path in named if path is not None], read)
    expected_mm = args.expected_baseline_mm
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
