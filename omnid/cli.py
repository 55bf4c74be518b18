"""The command line: runs a command and turns errors that the user can correct into one line and exit code 2."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from itertools import dropwhile, takewhile
from operator import methodcaller
from typing import TYPE_CHECKING, Final, NoReturn, cast

from omnid.engine.process import handle_stop_signals
from omnid.version import __version__

if TYPE_CHECKING:
    from omnid.commands.options import Command


# Words of each command that has no subcommands -> its module of omnid.commands, with :NAME where it is not called `run`
# in it, and its line in the list of commands. A module is imported when its command is named.
COMMANDS: Final[Mapping[str, tuple[str, str]]] = {
    "run": ("runs", "the daemon: live cameras in, poses on the bus, commands to the wheels"),
    "simulate": ("runs:simulate", "the daemon with a simulated robot in a simulated world"),
    "replay": ("runs:replay", "run a recorded log through the stages of the daemon"),
    "demo": ("runs:demo", "replay a sample in real time, with files and bus"),
    "eval": ("recordings:evaluate_run", "compare a trajectory with the truth, both in the TUM format"),
    "calibrate live": ("calibrate:live", "images of a board, with its coverage and what is missing"),
    "calibrate rig": ("calibrate:of_board", "a rig.toml from images of a board that both cameras saw"),
    "calibrate drive": ("calibrate:drive", "what drives say about a rig, and the rig that they make"),
    "calibrate import": (
        "calibrate:import_rig",
        "a rig.toml from files of other programs, or of two 360-degree cameras",
    ),
    "cameras": ("machine:show_cameras", "list cameras and the names of their ports, or show what they see"),
    "arm": ("robot:arm", "let the wheels turn, after the robot's start, a stop or a fault"),
    "stop": ("robot:stop", "stop the wheels until `omnid arm`; everyone who can connect may"),
    "drive": ("robot:drive", "drive a robot by the keyboard"),
    "goto": ("robot:goto", "drive a robot to a pose, around obstacles"),
    "route teach": ("robot:teach", "record a route while somebody drives (`omnid drive`, a joystick)"),
    "route repeat": ("robot:repeat", "drive a route, from where the robot is on it"),
    "route stop": ("robot:end_route", "end the repetition, or the recording without a file"),
    "route list": ("robot:list_routes", "the routes in navigation.routes, here"),
    "listen": ("machine:listen", "show pose, state, rates and latencies of a robot"),
    "view": ("recordings:view", "show a recording or a robot: path, map, images, plots (needs rerun)"),
    "web": ("machine:web", "a page with state, path, warnings, stop and arm"),
    "batch": ("batch", "replay many logs; goes on where it was interrupted (extra `fleet`)"),
    "record": ("runs:record", "record both cameras to MCAP files until Ctrl-C"),
    "report": ("recordings:report", "one HTML page about a recording: path, events, statistics"),
    "log info": ("recordings:info", "topics, types, counts, times, attachments, and whether the log is whole"),
    "map build": ("map:build", "build a map from logs, of one drive or of several in the same place"),
    "map show": ("map:show", "keyframes, sessions, loops, size, and the rig that made the map"),
    "map export": ("map:export", "write a map for other programs"),
    "map save": ("robot:save_map", "ask a robot to save its map now, before it is switched off"),
    "doctor": ("machine:doctor", "check cameras, motor, rig, rights, bus and disk"),
    "motor test": ("machine:test_motor", "turn each wheel, ask what moved, print the settings for that"),
    "config": ("machine:print_config", "print or check settings"),
    "install-service": ("machine:install_service", "install omnid as a systemd service"),
}
# First word of commands with subcommands -> its line in the list of commands.
GROUPS: Final[Mapping[str, str]] = {
    "calibrate": "make a rig.toml",
    "route": "teach a route by driving it, and repeat it",
    "log": "show the content of logs",
    "map": "build, show and export maps of places (.omap)",
    "motor": "test the wiring of the motors: sides, directions, scale",
}


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print the error and end the program."""
        self.exit(2, f"omnid: {' '.join(message.split())}; see {self.prog} --help\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return the exit code: 0 good, 1 not good (see the command), 2 wrong input, 128 + a signal."""
    # OpenCV reads this limit of images when it is loaded: drivers.frame.MAX_PIXELS, whose import would load OpenCV.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(64 * 2**20))
    # numpy reads this when it is loaded: the matrices are small, and threads of BLAS wait for the next one without
    # sleeping: see the row `libraries` of `OPENBLAS_NUM_THREADS=2 python -m tests.bench.daemon`.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = list(sys.argv[1:] if argv is None else argv)
    if _is_completing():
        words = os.environ["COMP_LINE"].split()[1:]
    if not words and not _is_completing():
        parser_of(words).print_help()
        return 0
    with ExitStack() as handlers:  # A signal ends the program at once while modules are loaded.
        with suppress(ValueError):  # outside the main thread signals stay as they are
            handlers.enter_context(handle_stop_signals(lambda number, _: os._exit(128 + number)))
        args = parser_of(words).parse_args(words)
        from calib.errors import CalibError
        from drivers.errors import DriverError
        from omnid.engine.logging_setup import configure_logging, log
        from omnid.errors import OmnidError

    configure_logging()
    try:
        code = int(args.command.run(args))
        sys.stdout.flush()
        return code
    except (OmnidError, DriverError, CalibError) as error:
        log(logging.ERROR, str(error))
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # the reader of the output has gone, such as `head`
        _discard_stdout()
        return 141
    except OSError as error:  # not handled by the command: a full disk, a file name that is too long
        log(logging.ERROR, f"{error.filename or 'cannot write'}: {error.strerror or error}")
        _discard_stdout()
        return 2


def parser_of(words: Sequence[str]) -> Parser:
    """Return the parser of the command that the words name, whose module alone is imported; else of all names."""
    parser = Parser(prog="omnid", description="Odometry, map and guidance from two stacked omnidirectional cameras.")
    parser.add_argument("--version", action="version", version=f"omnid {__version__}")
    parents = {"": parser.add_subparsers(required=True, metavar="command", parser_class=Parser)}
    is_option = methodcaller("startswith", "-")
    leading = list(takewhile(lambda word: not is_option(word), dropwhile(is_option, words)))
    named = next((name for name in (" ".join(leading[:2]), *leading[:1]) if name in COMMANDS), None)
    for name in COMMANDS if named is None or _is_completing() else (named,):
        first, _, second = name.partition(" ")
        if second and first not in parents:
            about = GROUPS[first]
            below = parents[""].add_parser(first, help=about, description=f"{about[:1].upper()}{about[1:]}.")
            parents[first] = below.add_subparsers(required=True, metavar="action", parser_class=Parser)
        place, about = COMMANDS[name]
        leaf = parents[first if second else ""].add_parser(second or first, help=about)
        if name == named:
            command_at(place).add_to(leaf)
    if _is_completing():
        with suppress(ImportError):  # the extra `completion`
            import argcomplete

            argcomplete.autocomplete(parser)  # prints what fits and ends the program
    return parser


def command_at(place: str) -> Command:
    """Import a command."""
    module, _, name = place.partition(":")
    return cast("Command", getattr(import_module(f"omnid.commands.{module}"), name or "run"))


def _is_completing() -> bool:
    """True if the shell asks for completions of what is typed (argcomplete)."""
    return "_ARGCOMPLETE" in os.environ


def _discard_stdout() -> None:
    """Discard the buffered standard output."""
    with suppress(OSError):  # it may have no file descriptor
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
