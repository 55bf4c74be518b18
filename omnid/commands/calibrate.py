"""Commands that make a rig.toml: `omnid calibrate live`, `rig`, `drive`, `import`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from calib import se3
from calib.boards.board import AnyBoard, AprilGrid, Board
from calib.importers import import_pair, parse_chain, stacked_rig, straight_up
from calib.models.names import model_in_words
from calib.rig import SIDES, Rig
from calib.rig_file import png, read_rig, write_rig
from calib.validation import read_text, silent
from drivers.logs.log_reader import LogCameras, LogReader
from omnid.calibration.drive import calibrate_drive
from omnid.calibration.from_log import calibrate_height, calibrate_mask
from omnid.calibration.images import read_pairs
from omnid.calibration.live_boards import LiveBoards, newest_pairs, status
from omnid.calibration.rig import calibrate_rig
from omnid.calibration.rig_check import check_log
from omnid.commands import options
from omnid.core.rig.rig_health import RigState
from omnid.engine.kernel_cache import prepare_kernels
from omnid.engine.logging_setup import HANDLER
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.runs.wiring import attached_rig
from omnid.sinks.files import check_outputs
from omnid.transport.bus import Bus
from omnid.transport.codec import diagnostics_cdr

T = TypeVar("T")
# Options that each kind of board needs.
NEEDED = {"checkerboard": ("corners", "square_mm"), "aprilgrid": ("tags", "tag_mm", "tag_spacing")}

BOARD: Final = """
board:
--board checkerboard|aprilgrid=checkerboard  aprilgrid: Kalibr's AprilTags 36h11, which may be half hidden
--corners 6x7        inner corners (points where four squares meet) along both sides
--square-mm MM       side of one square
--tags 6x6           aprilgrid: tags along x and y (Kalibr's tagCols x tagRows)
--tag-mm MM          aprilgrid: side of one tag (tagSize)
--tag-spacing RATIO  aprilgrid: space between tags as a fraction of a tag's side, like 0.3 (tagSpacing)
"""
REPLACE: Final = "--replace  write the rig in the place of an existing file, whose height and masks are lost"


def board_of(args: argparse.Namespace) -> AnyBoard:
    """Return the board that the options describe; OmnidError where they are not those of one kind of board."""
    given = {name for names in NEEDED.values() for name in names if getattr(args, name) is not None}
    if given != set(NEEDED[args.board]):
        needed = ", ".join(f"--{name.replace('_', '-')}" for name in NEEDED[args.board])
        raise OmnidError(f"--board {args.board}: expected {needed}, and no options of another kind of board")
    if args.board == "aprilgrid":
        columns, rows = args.tags
        return AprilGrid(columns, rows, args.tag_mm / 1e3, args.tag_spacing)
    columns, rows = args.corners
    return Board(columns, rows, args.square_mm / 1e3)


def require_new(args: argparse.Namespace) -> None:
    """Raise OmnidError where the rig would be written over another one, unless that is asked for."""
    if args.output.exists() and not args.replace:
        raise OmnidError(f"--output {args.output} exists: --replace writes the rig in its place")


@options.command(BOARD, options.LOG_CAMERAS, options.HEIGHT, REPLACE, options.QUIET)
def of_board(args: argparse.Namespace) -> int:
    """Make a rig.toml from images of a board that both cameras saw at once.

    Warnings go to stderr.

    images LOG|DIR    a log of both cameras, or a folder with lower_*.png, upper_*.png of the same names
    -o, --output FILE  the rig.toml to write (required)
    --expected-baseline-mm MM 0.001..  the measured distance of the mirrors: a result that differs by more than a tenth
        is refused
    --view mirror|direct  the world is seen in a mirror or directly through a lens; the tags of an AprilTag grid show
        it, a checkerboard does not
    --report FILE     write an HTML report with the residuals

    examples:
      calibrate rig boards.mcap --corners 6x7 --square-mm 30 --view mirror -o rig.toml
      calibrate rig DIR --board aprilgrid --tags 6x6 --tag-mm 88 --tag-spacing 0.3 -o rig.toml
    """
    board = board_of(args)
    reports = [("--report", args.report)] if args.report else []
    check_outputs([("--output", args.output), *reports], [("a file that is read", args.images)])
    require_new(args)
    expected_mm = args.expected_baseline_mm
    found = calibrate_rig(
        args.images,
        board,
        topics=log_cameras(args),
        view=args.view,
        expected_baseline_m=None if expected_mm is None else expected_mm / 1e3,
        progress=silent if args.quiet else lambda line: print(line, file=sys.stderr),
    )
    found = replace(found, rig=found.rig if args.height_m is None else found.rig.at_height(args.height_m))
    found.save(args.output)
    if args.report:
        found.save_report(args.report)
    for line in found.warnings:
        options.warn(line)
    for line in found.tables:
        print(line)
    print(f"{args.output}: {found}")
    print(f"{args.output}: {height_of(found.rig)}")
    return 0


@options.command(BOARD, options.SETTINGS)
def live(args: argparse.Namespace) -> int:
    """Search the board in the images of both cameras as they come.

    Pairs in which it stands still at a new place are written to DIR; the terminal says what is missing and when it is
    enough, the page (`omnid web`) also shows where it has been. Stop the daemon first: it holds the cameras. Exit code
    1: not enough yet.

    images DIR                       folder of the images, lower_*.png and upper_*.png; what is there counts, so that it
        goes on where it ended
    --lower DEVICE [cameras.lower]   device of the lower camera; default: cameras.lower of the settings
    --upper DEVICE [cameras.upper]   the same of the upper camera

    examples:
      calibrate live boards/ --corners 6x7 --square-mm 30 --config /etc/omnid/omnid.toml
    """
    config, folder, published_s = options.settings_of(args), args.images, 0.0
    with closing(LiveBoards(board_of(args))) as boards:
        # 1. What is in the folder.
        folder.mkdir(parents=True, exist_ok=True)
        names = [{path.stem.removeprefix(f"{side}_") for path in folder.glob(f"{side}_*")} for side in SIDES]
        if names[0] & names[1]:  # half a pair is left where it was killed between two files
            read = read_pairs(folder)
            for name in names[0] & names[1]:
                boards.process((read.sides[0][name], read.sides[1][name]), need_still=False)
        number = max((int(name) for name in names[0] | names[1] if name.isascii() and name.isdigit()), default=0)
        # 2. Pairs of the cameras until Ctrl-C.
        open_camera = options.device_opener(config)
        with (
            closing(open_camera("lower")) as lower,
            closing(open_camera("upper")) as upper,
            closing(Bus(config.bus)) as bus,
            suppress(KeyboardInterrupt),
        ):
            for pair in newest_pairs(lower, upper):
                outcome, missing = boards.process(pair, need_still=True), "; ".join(boards.missing()) or "enough"
                if outcome == "kept":
                    number += 1
                    for side, image in zip(SIDES, pair, strict=True):
                        write_whole(folder / f"{side}_{number:03d}.png", png(image))
                HANDLER.show(f"{boards.pairs} ({outcome}): {missing}")
                if time.monotonic() >= published_s + config.live.status_s:
                    published_s = time.monotonic()
                    bus.publish("status", diagnostics_cdr(time.time_ns(), [status(boards, outcome)]))
    HANDLER.show("")
    if missing := "; ".join(boards.missing()):
        return options.failed(f"{boards.pairs} pairs, not enough yet: {missing}")
    print(f"{boards.pairs} pairs, enough: `omnid calibrate rig {folder}` with the same options of the board")
    return 0


@options.command(options.LOG_CAMERAS, options.HEIGHT)
def drive(args: argparse.Namespace) -> int:
    """Adjust all parameters of a rig to a drive with turns, without a board.

    Then find the height of the cameras, if the rig states none, and what is fixed to them, where the log shows it. Exit
    code 1: the rig has drifted (--only check), or nothing was found that could be written.

    log LOG            a drive with turns; 100 to 350 pairs
    --rig FILE         the rig.toml to start from; a nominal one will do: mirror data sheet, centre of the images,
        baseline by ruler; default: the one attached to the log
    --only check|height|mask...  only this; may be repeated. check: compare the rig with the images;
        height: height and tilt of the cameras by the floor; mask: hide what is fixed to the cameras, by a log in which
        the robot turns once
    -o, --output FILE  the rig.toml to write; may be the file of --rig

    examples:
      calibrate drive drive.mcap --rig rig.toml -o better.toml
      calibrate drive drive.mcap --only check
      calibrate drive drive.mcap --only height --rig rig.toml -o rig.toml
    """
    # 1. The rig to start from.
    if args.output is not None:
        check_outputs([("--output", args.output)], [("the log that is read", args.log)])
    if args.rig is not None:
        start = read_rig(args.rig)
    else:
        with closing(LogReader(args.log, log_cameras(args))) as reader:
            start = attached_rig(reader, args.log)
    prepare_kernels()
    # 2. Check the rig, or adjust all of it.
    rig, has_drifted, topics = start, False, log_cameras(args)
    if "check" in args.only:
        checked = check_log(args.log, rig, topics)
        print(checked)
        has_drifted = checked.finding.state is not RigState.FITS
    elif not args.only:
        adjusted = calibrate_drive(args.log, rig, topics, lambda line: print(line, file=sys.stderr))
        print(adjusted)
        if not adjusted.is_better:
            print(f"{args.rig or 'the attached rig'} fits this drive as well as any rig")
        rig = adjusted.rig if adjusted.is_better else rig
    # 3. Find the height, and the masks; a log that shows none of them is no error but for --only.
    if args.height_m is not None:
        rig = rig.at_height(args.height_m)
    elif "height" in args.only or (not args.only and rig.height_m() is None):
        height = _measured(args, rig, calibrate_height)
        if height is not None:
            print(f"the rig so far: {height_of(rig)}")
            rig = height.rig
    if not args.only or "mask" in args.only:
        mask = _measured(args, rig, calibrate_mask)
        if mask is not None and (mask.share or args.only):
            rig = mask.rig
    # 4. Write the rig.
    if args.output is not None and rig is start:
        print("nothing was written")
    elif args.output is not None:
        write_rig(args.output, rig)
        print(f"{args.output}: written, {height_of(rig)}")
    is_found = rig is not start or bool(args.only)
    return 0 if is_found and not has_drifted else 1


def _measured(args: argparse.Namespace, rig: Rig, measure: Callable[[Path, Rig, LogCameras], T]) -> T | None:
    """Print and return what a log shows of a rig; None where it does not, which is an error for --only."""
    try:
        found = measure(args.log, rig, log_cameras(args))
    except OmnidError as error:
        if args.only:
            raise
        print(error)
        return None
    print(found)
    return found


@options.command(options.HEIGHT, REPLACE)
def import_rig(args: argparse.Namespace) -> int:
    """Make a rig.toml from a Kalibr file, from two OCamCalib files, or of two 360-degree cameras.

    camchain [FILE]  both cameras: Kalibr's camchain.yaml
    --lower CAMERA   the lower camera: its name in the camchain (cam0), or its file: OCamCalib's calib_results.txt
    --upper CAMERA   the same for the upper camera
    --equirectangular 3840x1920  two 360-degree cameras one above the other, with stitched images of this size; with
        --baseline
    --view mirror|direct        OCamCalib: the world is seen in a mirror (default) or directly through a lens
    --frame imu|cameras=imu     the rig frame of a file with T_cam_imu: that of the IMU, whose z must point up; cameras:
        the origin at the lower viewpoint, z to the upper one, x ahead
    -o, --output FILE           the rig.toml to write (required)
    --baseline M 0.001..5       metres from the lower viewpoint straight up to the upper one; both cameras look up and
        are equally oriented

    examples:
      calibrate import camchain.yaml -o rig.toml
      calibrate import --equirectangular 3840x1920 --baseline 0.2 -o rig.toml
    """
    read = [path for path in (args.camchain, args.lower, args.upper) if path]
    check_outputs([("--output", args.output)], [("a file that is read", Path(path)) for path in read])
    require_new(args)
    rig = _imported(args)
    if args.height_m is not None:
        rig = rig.at_height(args.height_m)
    write_rig(args.output, rig)
    T_upper_lower = rig.upper.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig)
    rotation_deg = np.rad2deg(np.linalg.norm(se3.rotation_log(se3.R_of(T_upper_lower))))
    lower, upper = (model_in_words(mounted.camera) for mounted in (rig.lower, rig.upper))
    placed = f"baseline {1e3 * rig.baseline_m:.1f} mm, upper rotated by {rotation_deg:.2f} deg, {height_of(rig)}"
    print(f"{args.output}: lower {lower}, upper {upper}, {placed}")
    return 0


def _imported(args: argparse.Namespace) -> Rig:
    named = ("camchain", "lower", "upper", "equirectangular", "baseline", "view")
    given = {name for name in named if vars(args)[name] is not None}
    if given == {"equirectangular", "baseline"}:
        return stacked_rig(args.equirectangular, args.baseline)
    if "camchain" in given <= {"camchain", "lower", "upper"}:
        text, path = read_text(args.camchain), str(args.camchain)
        return parse_chain(text, path, args.lower or "", args.upper or "", args.frame, options.warn)
    if given - {"view"} == {"lower", "upper", "baseline"}:
        T_lower_upper = straight_up(args.baseline)
        return import_pair(Path(args.lower), Path(args.upper), T_lower_upper, args.view or "mirror", options.warn)
    raise OmnidError(
        "calibrate import: expected a Kalibr camchain.yaml; or two files of OCamCalib as --lower and --upper, with "
        "--baseline METRES; or --equirectangular WIDTHxHEIGHT with --baseline METRES"
    )


def height_of(rig: Rig) -> str:
    """Return the height that a rig states, in words."""
    if (height_m := rig.height_m()) is None:
        return "no height of the cameras (--height-m, or `omnid calibrate drive LOG --only height`)"
    return f"cameras {height_m:.3f} m above the floor"


def log_cameras(args: argparse.Namespace) -> LogCameras:
    """Return the cameras of a log by --lower, --upper, --bits and --time."""
    return LogCameras(args.lower, args.upper, int(args.bits), args.time)
