"""Calibration with a board: `omnid calibrate live` collects its images, `omnid calibrate rig` makes a rig of them."""

from __future__ import annotations

import argparse
import logging
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from calib.atomic_file import write_file
from calib.boards.aprilgrid import AprilGrid
from calib.boards.board import Board
from calib.rig_file import png
from calib.validation import silent
from drivers.logs.log_reader import LogCameras
from omnid.calibration.board_search import AnyBoard
from omnid.calibration.images import SIDES, Image, read_pairs
from omnid.calibration.live_boards import LiveBoards, PairOutcome, newest_pairs, status
from omnid.calibration.rig import calibrate_rig
from omnid.commands import options
from omnid.config import Config
from omnid.engine.logging_setup import HANDLER, log
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs
from omnid.transport.bus import Bus
from omnid.transport.codec import diagnostics_cdr

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
--tag-spacing RATIO  aprilgrid: space between tags as a fraction of a tag's side, like 0.3 (tagSpacing)
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


@options.command(BOARD, options.LOG_CAMERAS, options.HEIGHT, options.QUIET)
def rig(args: argparse.Namespace) -> int:
    """Make a rig.toml from images of a board that both cameras saw at once.

    Warnings go to stderr.

    images LOG|DIR    a log of both cameras, or a folder with lower_*.png, upper_*.png of the same names
    -o, --output FILE  the rig.toml to write (required)
    --expected-baseline-mm MM 0.001..  the measured distance of the mirrors: a result that differs by more than a tenth
        is refused
    --view mirror|direct  the world is seen in a mirror or directly through a lens; the tags of an AprilTag grid show
        it, a checkerboard does not
    --report FILE     write an HTML report with residuals and panoramas

    examples:
      calibrate rig boards.mcap --corners 6x7 --square-mm 30 --view mirror -o rig.toml
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
        topics=options.log_cameras(args),
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
    print(f"{args.output}: {options.height_of(found.rig)}")
    return 0


@options.command(BOARD, options.SETTINGS)
def live(args: argparse.Namespace) -> int:
    """Search the board in the images of both cameras as they come.

    Pairs in which it stands still at a new place are written to DIR; the terminal says what is missing and when it is
    enough, the page (`omnid web`) also shows where it has been. Stop the daemon first: it holds the cameras. Exit code
    1: not enough yet.

    images [DIR]           folder of the images, lower_*.png and upper_*.png; what is there counts, so that it goes on
        where it ended
    --log LOG              take the pairs of a log instead; without DIR they are only judged
    --lower DEVICE|TOPIC   device of the lower camera; default: cameras.lower of the settings; of --log the topic,
        default: found by name
    --upper DEVICE|TOPIC   the same of the upper camera

    examples:
      calibrate live boards/ --corners 6x7 --square-mm 30 --config /etc/omnid/omnid.toml
      calibrate live --log boards.mcap --corners 6x7 --square-mm 30
    """
    boards = LiveBoards(board_of(args))
    if args.images is None and args.log is None:
        raise OmnidError("calibrate live: expected the DIR of the images, found none: name a folder, or a --log")
    config = options.settings_of(args, {} if args.log else {"cameras.lower": args.lower, "cameras.upper": args.upper})
    with ExitStack() as closing:
        closing.callback(boards.close)
        number = _taken_before(args.images, boards)
        pairs = _of_log(args, config) if args.log else _of_cameras(config, closing)
        bus, published_s = _bus(config, closing), 0.0
        with suppress(KeyboardInterrupt):
            for pair in pairs:
                outcome = boards.process(pair, need_still=args.log is None)
                if outcome == "kept" and args.images is not None:
                    number += 1
                    for side, image in zip(SIDES, pair, strict=True):
                        write_file(args.images / f"{side}_{number:03d}.png", png(image))
                _show(boards, outcome)
                if bus is not None and time.monotonic() >= published_s + config.live.status_s:
                    published_s = time.monotonic()
                    bus.publish("status", diagnostics_cdr(time.time_ns(), [status(boards, outcome)]))
    HANDLER.show("")
    if missing := boards.missing():
        return options.failed(f"{boards.pairs} pairs, not enough yet: {'; '.join(missing)}")
    view = ["--view", "mirror"] if args.board == "checkerboard" else []
    words = shlex.join([str(args.images or args.log), *options_of(args), *view])
    print(f"{boards.pairs} pairs, enough: omnid calibrate rig {words} -o rig.toml (through lenses: --view direct)")
    return 0


def _taken_before(folder: Path | None, boards: LiveBoards) -> int:
    """Take the pairs that are in the folder, which is made if it is missing; return the highest number of an image."""
    if folder is None:
        return 0
    folder.mkdir(parents=True, exist_ok=True)
    lower, upper = ({path.stem.removeprefix(f"{side}_") for path in folder.glob(f"{side}_*")} for side in SIDES)
    if lower & upper:  # half a pair is left where it was killed between two files
        pairs = read_pairs(folder)
        for name in pairs.names:
            if all(name in side for side in pairs.sides):
                boards.process((pairs.sides[0][name], pairs.sides[1][name]), need_still=False)
    return max((int(name) for name in lower | upper if name.isascii() and name.isdigit()), default=0)


def _of_log(args: argparse.Namespace, config: Config) -> Iterator[tuple[Image, Image]]:
    of_log = LogCameras(args.lower, args.upper, config.cameras.bits, config.log.rate_hz, config.log.time)
    pairs = read_pairs(args.log, of_log)
    for line in pairs.notes:
        options.warn(line)
    return ((pairs.sides[0][name], pairs.sides[1][name]) for name in pairs.names)


def _of_cameras(config: Config, closing: ExitStack) -> Iterator[tuple[Image, Image]]:
    open_camera = options.device_opener(config)
    lower = open_camera("lower")
    closing.callback(lower.close)
    upper = open_camera("upper")
    closing.callback(upper.close)
    return newest_pairs(lower, upper)


def _bus(config: Config, closing: ExitStack) -> Bus | None:
    """Return the bus for the page; None where another program holds the endpoint."""
    try:
        bus = Bus(config.bus)
    except OmnidError as error:
        log(logging.WARNING, f"the page will not show it: {error}")
        return None
    closing.callback(bus.close)
    return bus


def _show(boards: LiveBoards, outcome: PairOutcome) -> None:
    """Show the newest outcome: one line on a terminal, which the next one replaces, else one for each kept pair."""
    missing = "; ".join(boards.missing()) or "enough"
    if sys.stdout.isatty():
        HANDLER.show(f"{boards.pairs} ({outcome}): {missing}")
    elif outcome == "kept":
        print(f"{boards.pairs}: {missing}", flush=True)
