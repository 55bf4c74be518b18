"""The options --jobs and --dask, those of the programs that workers start, and the end of these programs."""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

from omnid.commands.options import Option, option


def workers(what: str, default: int) -> tuple[Option, Option]:
    """Declare --jobs and --dask."""
    return (
        option("--jobs", type=int, default=default, metavar="N", help=f"{what}; default: %(default)s"),
        option(
            "--dask",
            metavar="ADDRESS",
            help="run on the workers of this dask scheduler, such as tcp://HOST:8786; they need the same paths (extra "
            "`fleet`)",
        ),
    )


def program_options(
    paths: Mapping[str, Path | None], words: Mapping[str, str | None], overrides: Sequence[str]
) -> list[str]:
    """Return the given options for the program of a worker, which may run in another folder: its paths are absolute.

    paths, words: values by the names of their options; None: not given. overrides: the settings of --set.
    """
    given = {option: str(path.absolute()) for option, path in paths.items() if path is not None}
    given |= {option: word for option, word in words.items() if word is not None}
    pairs = [*given.items(), *(("--set", override) for override in overrides)]
    return [word for pair in pairs for word in pair]


def end_by_sigterm() -> None:
    """Let SIGTERM have the effect of Ctrl-C: the programs of the workers end, too."""
    signal.signal(signal.SIGTERM, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt
