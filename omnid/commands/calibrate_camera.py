"""`omnid calibrate camera`: calibrate one camera by images of a board."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from calib.fit.boards.camera_selection import MODEL_CHOICES
from omnid.calibration.camera import CameraResult, calibrate_camera
from omnid.calibration.progress import Progress, silent
from omnid.calibration.view_guess import VIEW_CHOICES, VIEW_HELP
from omnid.commands.board_options import BOARD, board_of
from omnid.commands.options import command, option
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs

if TYPE_CHECKING:
    from omnid.calibration.rig import RigResult

MODEL_HELP = (
    "auto (default): fit all models and select by cross-validation; omni: unified model; ocam: polynomial; "
    "ocam_tangential: polynomial with tangential terms"
)


@command(
    option("images", nargs="+", metavar="IMAGES|LOG", help="files, folders or patterns, or one .mcap"),
    BOARD,
    option("--topic", help="the camera's topic in a log"),
    option("--model", choices=MODEL_CHOICES, default="auto", help=MODEL_HELP),
    option("--view", choices=VIEW_CHOICES, default="auto", help=VIEW_HELP),
    option("--report", type=Path, metavar="FILE", help="write an HTML report with residuals and coverage"),
    option(
        "--mask",
        type=Path,
        metavar="FILE",
        help="also find rim, hub and struts, and write them to "
        "this PNG in the folder of the camera's file; it may be edited",
    ),
    option("--quiet", action="store_true", help="no progress"),
    option("-o", "--output", type=Path, required=True, help="the camera.toml to write"),
    examples=("calibrate camera boards/*.png --corners 6x7 --square-mm 30 -o camera.toml",),
)
def run(args: argparse.Namespace) -> int:
    """Calibrate the camera, write the files and print one line."""
    board = board_of(args)
    _check_outputs(args)
    found = calibrate_camera(
        args.images,
        board,
        topic=args.topic,
        model=args.model,
        view=args.view,
        with_mask=args.mask is not None,
        progress=progress_of(args),
    )
    found.save(args.output, args.mask)
    if args.report:
        found.save_report(args.report)
    print_result(args.output, found)
    return 0


def progress_of(args: argparse.Namespace) -> Progress:
    """Return what prints the progress on stderr, unless --quiet."""
    return silent if args.quiet else lambda line: print(line, file=sys.stderr)


def print_result(output: Path, found: CameraResult | RigResult) -> None:
    """Print the warnings on stderr and the result as one line."""
    for line in found.warnings:
        print(f"warning: {line}", file=sys.stderr)
    print(f"{output}: {found}")


def _check_outputs(args: argparse.Namespace) -> None:
    named = [("--output", args.output), ("--report", args.report), ("--mask", args.mask)]
    sources = map(Path, args.images)
    read = [("an image that is read", path if path.exists() else path.parent) for path in sources]  # of a pattern
    check_outputs([(option, path) for option, path in named if path is not None], read)
    if args.mask and (args.mask.suffix.lower() != ".png" or args.mask.parent.resolve() != args.output.parent.resolve()):
        raise OmnidError(f"--mask {args.mask}: expected a .png in the folder of {args.output}")
