"""The command line: runs a command and turns errors that the user can correct into one line and exit code 2."""

from __future__ import annotations

import argparse
import difflib
import logging
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, NoReturn

from omnid.commands.examples import add_examples
from omnid.version import __version__

COMMANDS = (
    "run",
    "simulate",
    "replay",
    "demo",
    "eval",
    "accept",
    "calibrate",
    "cameras",
    "arm",
    "stop",
    "drive",
    "goto",
    "route",
    "listen",
    "view",
    "web",
    "batch",
    "record",
    "report",
    "log",
    "map",
    "diff",
    "doctor",
    "motor",
    "config",
    "install-service",
)
MODULES = {"eval": "evaluate", "install-service": "install_service"}  # eval is a name of Python itself
# Commands and options of earlier versions, and what to use in their place.
REMOVED = {
    "listen --all": "one program for each robot, with --robot NAME; many robots: Grafana on /metrics of `omnid web`",
    "log recover": "omnid reads cut logs as they are; for other programs: `mcap recover`, of mcap's own command line",
    "web --all": "one page for each robot, with --robot NAME and --listen HOST:PORT, in tabs of one browser",
    "web --recordings": "the page lists no recordings; `omnid report LOG` writes the same report",
}
WRONG_INPUT = 2
# What argparse says of a word that is not among the choices; Python 3.12 and later do not quote them.
_CHOICE = re.compile(r"argument (?P<name>.*): invalid choice: '(?P<found>.*)' \(choose from (?P<all>.*)\)", re.DOTALL)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, which proposes the word that was probably meant."""

    def parse_known_args(  # type: ignore[override]  # the overloads of argparse differ only in the namespace's type
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[Any, list[str]]:
        """Parse as argparse does, but refuse unknown words here, where the help of this very command is known."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            options = [option for action in self._actions for option in action.option_strings]
            self.error(f"unknown argument {unknown[0]}{_did_you_mean(unknown[0].partition('=')[0], options)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """Print the error and end the program."""
        wrong = _CHOICE.fullmatch(message)
        if wrong:
            choices = [choice.strip("' ") for choice in wrong["all"].split(",")]
            among = _did_you_mean(wrong["found"], choices) or f": expected one of {', '.join(choices)}"
            name = wrong["name"] if wrong["name"].startswith("-") else "unknown command"
            message = f"{name} {wrong['found']!r}{among}"
        colon = "" if message.endswith("?") else ":"
        self.exit(WRONG_INPUT, f"omnid: {' '.join(message.split())}{colon} see {self.prog} --help\n")


def _did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return the question for the nearest of the known words, or an empty text."""
    nearest = difflib.get_close_matches(word[:80], known, n=1, cutoff=0.6)
    return f": did you mean {nearest[0]}?" if nearest else ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return the exit code: 0 good, 1 not good (see the command), 2 wrong input, 130 Ctrl-C."""
    _open_closed_streams()
    bound_image_size()
    limit_blas_threads()
    words = list(sys.argv[1:] if argv is None else argv)
    for removed, instead in REMOVED.items():
        command, _, option = removed.partition(" --")
        given = {word.partition("=")[0] for word in words}
        if words[: len(command.split())] == command.split() and (not option or f"--{option}" in given):
            print(f"omnid: `omnid {removed}` was removed: {instead}", file=sys.stderr)
            return WRONG_INPUT
    args = _parser(words).parse_args(words)
    return _guarded(args)


def _open_closed_streams() -> None:
    """Open stdout and stderr if they were closed, else the next file would get their number and all prints."""
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 - open until the end of the program
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115 - open until the end of the program


def bound_image_size() -> None:
    """Let OpenCV refuse image files that would take much memory, of any format.

    OpenCV reads the variable when it is loaded, so this comes before the first import of it. The value is
    drivers.frame.MAX_PIXELS, whose module loads OpenCV. `import omnid` leaves the environment of a program as it is:
    there, frames are bounded by their headers (drivers/frame.py).
    """
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(64 * 2**20))


def limit_blas_threads() -> None:
    """Let BLAS work with one thread, unless the user wants more; it reads the variable when numpy is loaded.

    The matrices are small, and its threads wait for the next one without sleeping: see the row `libraries` of
    `OPENBLAS_NUM_THREADS=2 python -m tests.benchmark.daemon`.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _parser(words: Sequence[str]) -> Parser:
    """Return a parser of the named command only, because the import of some takes a second; else of all."""
    parser = Parser(prog="omnid", description="Odometry, map and guidance from two stacked omnidirectional cameras.")
    parser.add_argument("--version", action="version", version=f"omnid {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="command", parser_class=Parser)
    named = next((word for word in words if not word.startswith("-")), "")
    if named in COMMANDS and not _completes():
        names: Sequence[str] = (named,)
    else:
        names = () if "--version" in words else COMMANDS
    for name in names:
        module = import_module(f"omnid.commands.{MODULES.get(name, name)}")
        listed = len(names) > 1 and not {"-h", "--help"}.isdisjoint(words)  # the help of all commands
        add = getattr(module, "add_listed", module.add_parser) if listed else module.add_parser
        add(subparsers)
    add_examples(parser)
    if _completes():
        with suppress(ImportError):  # the extra `completion`
            import argcomplete

            argcomplete.autocomplete(parser)  # prints what fits and ends the program
    return parser


def _completes() -> bool:
    """True if the shell asks for completions of what is typed (argcomplete)."""
    return "_ARGCOMPLETE" in os.environ


def _guarded(args: argparse.Namespace) -> int:
    from calib.errors import CalibError
    from drivers.errors import DriverError
    from omnid.engine.logging_setup import configure_logging, log_unlimited
    from omnid.errors import OmnidError

    configure_logging()
    try:
        code = int(args.run(args))
        sys.stdout.flush()
        return code
    except (OmnidError, DriverError, CalibError) as error:
        log_unlimited(logging.ERROR, str(error))
        return WRONG_INPUT
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of the output has gone, such as `head`
        _discard_stdout()
        return 141
    except OSError as error:  # not handled by the command: a full disk, a file name that is too long
        log_unlimited(logging.ERROR, f"{error.filename or 'cannot write'}: {error.strerror or error}")
        _discard_stdout()
        return WRONG_INPUT


def _discard_stdout() -> None:
    """Discard the buffered standard output."""
    with suppress(OSError):  # it may have no file descriptor
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
