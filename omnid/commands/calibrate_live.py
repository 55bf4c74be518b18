"""`omnid calibrate live`: boards before the cameras, with the coverage so far and what is missing."""

from __future__ import annotations

import argparse
import logging
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from calib.atomic_file import write_file
from calib.rig_file import png
from drivers.logs.log_reader import LogCameras
from omnid.calibration.images import SIDES, Image, read_pairs
from omnid.calibration.live_boards import LiveBoards, PairOutcome, newest_pairs, status
from omnid.commands.calibrate_options import BOARD, board_of, options_of
from omnid.commands.options import SETTINGS, command, device_opener, make_folder, settings_of, warn
from omnid.config import Config
from omnid.engine.logging_setup import log
from omnid.errors import OmnidError
from omnid.transport.bus import Bus
from omnid.transport.codec import diagnostics_cdr

PUBLISH_S: Final = 0.5


@command(BOARD, SETTINGS)
def run(args: argparse.Namespace) -> int:
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
    config = settings_of(args, {} if args.log else {"cameras.lower": args.lower, "cameras.upper": args.upper})
    with ExitStack() as closing:
        closing.callback(boards.close)
        number = _taken_before(args.images, boards)
        pairs = _of_log(args, config) if args.log else _of_cameras(config, closing)
        bus, published_s = _bus(config, closing), -PUBLISH_S
        with suppress(KeyboardInterrupt):
            for pair in pairs:
                outcome = boards.process(pair, need_still=args.log is None)
                if outcome == "kept" and args.images is not None:
                    number += 1
                    for side, image in zip(SIDES, pair, strict=True):
                        write_file(args.images / f"{side}_{number:03d}.png", png(image))
                _show(boards, outcome)
                if bus is not None and time.monotonic() >= published_s + PUBLISH_S:
                    published_s = time.monotonic()
                    if bus.needs_router:
                        bus.connect()
                    bus.publish("status", diagnostics_cdr(time.time_ns(), [status(boards, outcome)]))
    if missing := boards.missing():
        print(f"omnid: {boards.pairs} pairs, not enough yet: {'; '.join(missing)}", file=sys.stderr)
        return 1
    words = shlex.join([str(args.images or args.log), *options_of(args)])
    print(f"{boards.pairs} pairs, enough: omnid calibrate rig {words} -o rig.toml")
    return 0


def _taken_before(folder: Path | None, boards: LiveBoards) -> int:
    """Take the pairs that are in the folder, which is made if it is missing; return the highest number of an image."""
    if folder is None:
        return 0
    make_folder("calibrate live: DIR", folder)
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
        warn(line)
    return ((pairs.sides[0][name], pairs.sides[1][name]) for name in pairs.names)


def _of_cameras(config: Config, closing: ExitStack) -> Iterator[tuple[Image, Image]]:
    open_camera = device_opener(config)
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
    """Print the newest outcome: one line on a terminal, which the next one replaces, else one for each kept pair."""
    missing = "; ".join(boards.missing()) or "enough"
    if sys.stdout.isatty():
        width = shutil.get_terminal_size().columns - 1
        print("\r" + f"{boards.pairs} ({outcome}): {missing}"[:width].ljust(width), end="", flush=True)
    elif outcome == "kept":
        print(f"{boards.pairs}: {missing}", flush=True)
