"""The command line: finds the command, runs it, and turns what the user can put right into one line and exit code 2."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

from omnid import __version__

COMMANDS = ("run", "replay", "demo", "eval", "calibrate", "cameras", "listen", "view", "record", "report", "log",
            "diff", "doctor", "config")
MODULES = {"eval": "evaluate"}  # eval is a name that Python has taken
WRONG = 2


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Ends the program."""
        self.exit(WRONG, f"omnid: {' '.join(message.split())}: see {self.prog} --help\n")


def main(argv: Sequence[str] | None = None) -> int:
    """The exit code: 0 all is well, 1 found wanting, 2 the input is wrong, 130 stopped by Ctrl-C."""
    _open_what_is_closed()
    words = list(sys.argv[1:] if argv is None else argv)
    args = _parser(words).parse_args(words)
    return _guarded(args)


def _open_what_is_closed() -> None:
    """Whoever starts us may have closed stdout or stderr: the next file would take its number, and what is said."""
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 - as long as the program
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115 - as long as the program


def _parser(words: Sequence[str]) -> Parser:
    """Only the command that is asked for is loaded: some take a second to be."""
    parser = Parser(prog="omnid", description="Odometry, map and guidance from two stacked omnidirectional cameras.")
    parser.add_argument("--version", action="version", version=f"omnid {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="command", parser_class=Parser)
    asked = next((word for word in words if not word.startswith("-")), "")
    for name in (asked,) if asked in COMMANDS else COMMANDS if "--version" not in words else ():
        import_module(f"omnid.commands.{MODULES.get(name, name)}").add_parser(subparsers)
    return parser


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
        return WRONG
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # whoever read our output has gone, as `head` does
        _hush()
        return 141
    except OSError as error:  # what no command has foreseen: a disk that is full, a name that is too long
        log_unlimited(logging.ERROR, f"{error.filename or 'cannot write'}: {error.strerror or error}")
        _hush()
        return WRONG


def _hush() -> None:
    """What is still to be written to the standard output goes nowhere."""
    with suppress(OSError):  # it may be no file at all
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
