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
from typing import TYPE_CHECKING, Final

from omnid.commands.calibrate_options import BOARD, board_of, options_of
from omnid.commands.options import SETTINGS, command, device_opener, make_folder, settings_of, warn
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.calibration.images import Image
    from omnid.calibration.live_boards import LiveBoards, PairOutcome
    from omnid.config import Config
    from omnid.transport.bus import Bus

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
    from omnid.calibration.live_boards import LiveBoards

    board = board_of(args)
    if args.images is None and args.log is None:
        raise OmnidError("calibrate live: expected the DIR of the images, found none: name a folder, or a --log")
    named = {} if args.log else {"cameras.lower": args.lower, "cameras.upper": args.upper}
    config = settings_of(args, named)
    boards = LiveBoards(board)
    with ExitStack() as closing:
        closing.callback(boards.close)
        number = _taken_before(args.images, boards)
        pairs = _of_log(args) if args.log else _of_cameras(config, closing)
        bus, published_s = _bus(config, closing), -PUBLISH_S
        with suppress(KeyboardInterrupt):
            for pair in pairs:
                outcome = boards.process(pair, need_still=args.log is None)
                if outcome == "kept" and args.images is not None:
                    number += 1
                    _write(args.images, number, pair)
                _show(boards, outcome)
                if bus is not None and time.monotonic() >= published_s + PUBLISH_S:
                    published_s = time.monotonic()
                    _publish(bus, boards, outcome)
    return _finish(args, boards)


def _taken_before(folder: Path | None, boards: LiveBoards) -> int:
    """Take the pairs that are in the folder, which is made if it is missing; return the highest number of an image."""
    from omnid.calibration.images import SIDES, read_pairs

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


def _of_log(args: argparse.Namespace) -> Iterator[tuple[Image, Image]]:
    from drivers.logs.log_reader import LogCameras
    from omnid.calibration.images import read_pairs

    config = settings_of(args)
    log = config.log
    pairs = read_pairs(args.log, LogCameras(args.lower, args.upper, config.cameras.bits, log.rate_hz, log.time))
    for line in pairs.notes:
        warn(line)
    return ((pairs.sides[0][name], pairs.sides[1][name]) for name in pairs.names)


def _of_cameras(config: Config, closing: ExitStack) -> Iterator[tuple[Image, Image]]:
    from omnid.calibration.live_boards import newest_pairs

    open_camera = device_opener(config)
    lower = open_camera("lower")
    closing.callback(lower.close)
    upper = open_camera("upper")
    closing.callback(upper.close)
    return newest_pairs(lower, upper)


def _bus(config: Config, closing: ExitStack) -> Bus | None:
    """Return the bus for the page; None where another program holds the endpoint."""
    from omnid.engine.logging_setup import log
    from omnid.transport.bus import Bus

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


def _publish(bus: Bus, boards: LiveBoards, outcome: PairOutcome) -> None:
    """Send the newest outcome to the page."""
    from omnid.calibration.live_boards import status
    from omnid.transport.codec import diagnostics_cdr

    if bus.needs_router:
        bus.connect()
    bus.publish("status", diagnostics_cdr(time.time_ns(), [status(boards, outcome)]))


def _write(folder: Path, number: int, pair: tuple[Image, Image]) -> None:
    from calib.atomic_file import write_file
    from calib.rig_file import png

    for side, image in zip(("lower", "upper"), pair, strict=True):
        write_file(folder / f"{side}_{number:03d}.png", png(image))


def _finish(args: argparse.Namespace, boards: LiveBoards) -> int:
    missing = boards.missing()
    source = shlex.quote(str(args.images or args.log))
    if missing:
        print(f"omnid: {boards.pairs} pairs, not enough yet: {'; '.join(missing)}", file=sys.stderr)
        return 1
    print(f"{boards.pairs} pairs, enough: omnid calibrate rig {source} {shlex.join(options_of(args))} -o rig.toml")
    return 0
