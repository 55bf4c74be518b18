"""The options --jobs and --dask, and the end of programs that workers have started."""

from __future__ import annotations

import argparse
import signal
from types import FrameType
from typing import NoReturn


def add_workers(parser: argparse.ArgumentParser, what: str, default: int) -> None:
    """Add --jobs and --dask."""
    parser.add_argument("--jobs", type=int, default=default, metavar="N", help=f"{what}; default: %(default)s")
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="run on the workers of this dask scheduler, such as "
        "tcp://HOST:8786; they need the same paths (extra `fleet`)",
    )


def end_by_sigterm() -> None:
    """Let SIGTERM have the effect of Ctrl-C: the programs of the workers end, too."""
    signal.signal(signal.SIGTERM, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
