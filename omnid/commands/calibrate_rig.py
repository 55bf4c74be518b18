"""`omnid calibrate rig`: calibrate a rig by simultaneous images of a board."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from calib.camera_file import read_camera
from calib.fit.boards.camera_selection import MODEL_CHOICES
from omnid.calibration.rig import GivenCameras, calibrate_rig
from omnid.calibration.view_guess import VIEW_CHOICES, VIEW_HELP
from omnid.commands.board_options import BOARD, board_of
from omnid.commands.calibrate_camera import MODEL_HELP, print_result, progress_of
from omnid.commands.height_option import HEIGHT, height_of, with_height
from omnid.commands.options import cameras, command, option
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
    option("--lower-camera", type=Path, metavar="FILE", help="camera.toml of the lower camera, which is not changed"),
    option("--upper-camera", type=Path, metavar="FILE", help="the same for the upper camera"),
    option("--refine-cameras", action="store_true", help="adjust the given cameras as well"),
    *cameras("a log's topic of the {camera} camera"),
    option("--model", choices=MODEL_CHOICES, default="auto", help=MODEL_HELP),
    option("--view", choices=VIEW_CHOICES, default="auto", help=VIEW_HELP),
    option(
        "--mask",
        action="store_true",
        help="also find hub and struts, and write the masks to PNGs in "
        "the folder of the rig's file; they may be edited",
    ),
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
    """Calibrate the rig, write the files and print one line."""
    board = board_of(args)
    given = _given(args)
    _check_outputs(args)
    expected_m = None if args.expected_baseline_mm is None else args.expected_baseline_mm / 1e3
    found = calibrate_rig(
        args.images,
        board,
        topics=(args.lower, args.upper),
        cameras=given,
        refine_cameras=args.refine_cameras,
        model=args.model,
        view=args.view,
        with_struts=args.mask,
        expected_baseline_m=expected_m,
        progress=progress_of(args),
    )
    found = replace(found, rig=with_height(found.rig, args))
    found.save(args.output)
    if args.report:
        found.save_report(args.report)
    print_result(args.output, found)
    print(f"{args.output}: {height_of(found.rig)}")
    return 0


def _given(args: argparse.Namespace) -> GivenCameras | None:
    """Read both cameras' files, if named; raises OmnidError if only one is."""
    paths = [args.lower_camera, args.upper_camera]
    if not any(paths):
        if args.refine_cameras:
            raise OmnidError("--refine-cameras: expected --lower-camera and --upper-camera to refine, found neither")
        return None
    if not all(paths):
        raise OmnidError("calibrate rig: expected both --lower-camera and --upper-camera or neither, found one")
    return read_camera(paths[0]), read_camera(paths[1])


def _check_outputs(args: argparse.Namespace) -> None:
    named = [("--output", args.output), ("--report", args.report)]
    read = [
        ("a file that is read", path)
        for path in (args.images, args.lower_camera, args.upper_camera)
        if path is not None
    ]
    check_outputs([(option, path) for option, path in named if path is not None], read)
    expected = args.expected_baseline_mm
    if expected is not None and not expected > 0:
        raise OmnidError(f"--expected-baseline-mm {expected:g}: expected a length above 0")
