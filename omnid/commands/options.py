"""Commands and options of the command line: the docstring of a command is its help, and declares its options.

    @command(RIG, SETTINGS)
    def run(args: argparse.Namespace) -> int:
        '''Describe the command in sentences, which may follow the options, too.

        log LOG...                         a positional argument, one or more; [LOG]: may be missing
        --method default|paper=default     one of these words
        --size PX=512 64..2048             a number of 64 to 2048; 512 where it is not given
        --motor PORT [motor.port]          an option that stands for a setting: settings_of(args) contains it
        -o, --output FILE                  the file to write (required)
        --replace                          replace it

        examples:
          replay a.mcap
        '''

The type follows from the word in capitals (TYPES). A line such as `outputs:` gives the options below it a title, up to
an empty line; of those below `one of:` at most one may be given. What several commands take is declared once, here, in
the same way. `omnid/cli.py` names the module of each command. At the end: how commands print warnings and JSON.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.metadata import requires
from importlib.util import find_spec
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec

from omnid.engine.logging_setup import log
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from drivers.cameras.v4l2_camera import V4l2Camera
    from drivers.frame import Camera
    from omnid.config import Config

PROFILES: Final = {"small": ("panorama.scale=0.5", "odometry.limits.features=250")}
_DECLARED: Final = re.compile(
    r"(?P<names>-\S+(?:, --\S+)*|[a-z]+)(?: (?!\[[a-z_]+\.)(?P<value>[\[\dA-Za-z]\S*))?"
    r"(?: (?P<low>[\d.e-]*?)\.\.(?P<high>[\d.e]*))?(?: \[(?P<setting>[a-z_]+\.[a-z_.]+)\])?  +(?P<help>.+)"
)
_VALUE: Final = re.compile(r"(?P<optional>\[)?(?P<word>[^\]=]+?)\]?(?P<more>\.\.\.)?(?:=(?P<default>\S+))?")

Run: TypeAlias = Callable[[argparse.Namespace], int]
warn: Final = partial(log, logging.WARNING)


@dataclass(frozen=True, slots=True)
class Command:
    """A command without subcommands: what it does, and its help, which declares what it takes."""

    run: Run
    lines: tuple[str, ...]  # of the help up to the examples, each declaration in one line
    examples: tuple[str, ...]  # without `omnid`; a test parses them all

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Give a parser the options and the help of this command."""
        container: argparse._ActionsContainer = parser
        prose = list[str]()
        for line in self.lines:
            if found := _DECLARED.fullmatch(line):
                _add_option(container, found)
            elif line == "one of:":
                container = parser.add_mutually_exclusive_group()
            elif re.fullmatch("[a-z ]+:", line):
                container = parser.add_argument_group(line.removesuffix(":"))
            else:
                assert not line.startswith("-"), f"no declaration of an option: {line}"
                container = parser if not line else container
                prose.append(line)
        parser.formatter_class = _ExamplesFormatter
        parser.description = " ".join(filter(None, prose))
        parser.epilog = "\n".join(("examples:", *(f"  omnid {example}" for example in self.examples)))
        parser.set_defaults(command=self, parser=parser)


class _ExamplesFormatter(argparse.HelpFormatter):
    """Leaves the lines of the examples as they are, so that they can be copied; wraps all other text."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return text if text.startswith("examples:") else super()._fill_text(text, width, indent)


def command(*shared: str) -> Callable[[Run], Command]:
    """Make a command of a function from parsed arguments to the exit code; shared: further declarations."""

    def make(run: Run) -> Command:
        text, _, examples = cleandoc(run.__doc__ or "").partition("\nexamples:\n")
        joined = re.sub(r"\n +", " ", "\n\n".join((text, *shared)))
        return Command(run, tuple(joined.splitlines()), tuple(line.strip() for line in examples.splitlines()))

    return make


def _add_option(container: argparse._ActionsContainer, declared: re.Match[str]) -> None:
    """Add the option or positional argument of a line of the help."""
    names, text = declared["names"].split(", "), declared["help"]
    if declared["value"] is None:
        vars(container.add_argument(*names, action="store_true", help=text))["setting"] = declared["setting"]
        return
    value = _VALUE.fullmatch(declared["value"])
    assert value is not None, declared["value"]
    word, default, is_option = value["word"], value["default"], names[0].startswith("-")
    keywords: dict[str, Any] = {"default": default, "metavar": word}
    kind = TYPES.get(word) or (Path if set(re.split(r"\W", word)) & _PATHS else None)
    if kind is None and word == word.lower():
        keywords["choices"] = keywords.pop("metavar").split("|")
    elif declared["low"] is not None or kind in (int, float):
        low, high = (float(declared[end] or "nan") for end in ("low", "high"))
        kind = partial(_number, kind or float, low, high)
    if is_option:
        keywords |= {"action": "append", "default": []} if value["more"] else {"required": text.endswith("(required)")}
    elif value["optional"] or value["more"]:
        keywords["nargs"] = {("[", None): "?", ("[", "..."): "*", (None, "..."): "+"}[value["optional"], value["more"]]
    shown = text.replace("%", "%%") + (f"; default {default}" if default else "")
    action = container.add_argument(*names, type=kind or str, help=shown, **keywords)
    vars(action)["setting"] = declared["setting"]  # read by settings_of


def _number(kind: Callable[[str], Any], low: float, high: float, text: str) -> float:
    """Return the finite number of an option between bounds, of which NaN is none; ArgumentTypeError for others."""
    try:
        value: float = kind(text)
    except ValueError:
        value = math.nan
    if math.isfinite(value) and not (value < low or value > high):
        return value
    most = "" if math.isnan(high) else f" to {high:g}"
    wanted = "a number" if math.isnan(low) else f"{low:g}{most or ' or more'}"
    raise argparse.ArgumentTypeError(f"expected {wanted}, found {text!r}")


def two_sides(text: str) -> tuple[int, int]:
    """Parse the numbers along both sides, like 6x7."""
    sides = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if sides is None:
        raise argparse.ArgumentTypeError(f"expected two numbers like 6x7, found {text!r}")
    return int(sides[1]), int(sides[2])


# Types of values by the word that stands for them in the help; a file or a folder is a path, all others are text.
TYPES: Final[Mapping[str, Callable[[str], Any]]] = {
    **dict.fromkeys(("N", "PX", "BITS"), int),
    **dict.fromkeys(("X", "S", "M", "MM", "MS", "MPS", "FACTOR", "RATIO"), float),
    **dict.fromkeys(("6x7", "6x6", "3840x1920"), two_sides),
}
_PATHS: Final = {"FILE", "FOLDER", "DIR", "LOG", "EST", "TRUTH", "OUT"}


def settings_of(args: argparse.Namespace, more: Mapping[str, object] | None = None, *, run: str = "") -> Config:
    """Return the configuration of --config, --profile, --set, and of the options that stand for a setting.

    more: further settings by their names, None: not given; they win over the options. run: `run` or `replay`, to warn
    of the settings that it does not use.
    """
    from omnid.config import load_config, unused_settings

    actions = [action for action in args.parser._actions if getattr(action, "setting", "")]
    named = {action.setting: getattr(args, action.dest) for action in actions} | dict(more or {})
    # As --set takes them.
    given = [
        f"{path}={json.dumps(value) if isinstance(value, bool | list) else value}"
        for path, value in named.items()
        if not (value is None or value is False or value == [])
    ]
    profile = PROFILES[args.profile] if getattr(args, "profile", None) else ()
    config = load_config(args.config, [*profile, *args.set, *given])
    for warning in unused_settings(config, run, args.set) if run else ():
        warn(warning)
    return config


def require(extra: str, *modules: str) -> None:
    """Raise OmnidError where a package of an extra is not installed."""
    if missing := [name for name in modules if find_spec(name) is None]:
        mark = f"; extra == '{extra}'"
        packages = " ".join(f"'{line.removesuffix(mark)}'" for line in requires("omnid") or () if line.endswith(mark))
        raise OmnidError(f"{', '.join(missing)} is not installed: {sys.executable} -m pip install {packages}")


# Settings of any command.
FILE_AND_SET: Final = """
--config FILE     TOML file of settings; `omnid config` prints the defaults
--set SETTING...  SECTION.KEY=VALUE, a setting that replaces that of the file; may be repeated
"""
SETTINGS: Final = f"""{FILE_AND_SET}
--profile small   settings that replace those of the file; small: half-size panoramas and half the landmarks, for a
                  small computer
"""
JSON: Final = "--json  print the result as JSON"
QUIET: Final = "--quiet  do not show the progress"
VERBOSE: Final = "--verbose  print all counters, and the times of all stages"

# A robot on the bus.
ROBOT: Final = """
--robot NAME [bus.robot]            its name; default: bus.robot of the settings
--connect ENDPOINT... [bus.connect]  the robot or a router, such as tcp/robot:7447; default: bus.connect of the
                                    settings, without them this machine
"""
SECONDS: Final = "--seconds S 0.001..1e9  end after S seconds; default: on Ctrl-C"

# A log, its cameras and its rig.
RIG: Final = "--rig FILE  the rig.toml of the cameras; default: that attached to the log\n"
CAMERAS: Final = """
--lower TOPIC  images of the lower camera; default: found by name
--upper TOPIC  images of the upper camera; default: found by name
"""
LOG: Final = f"{RIG}{CAMERAS}"
LOG_CAMERAS: Final = f"""{CAMERAS}
--bits 8|10|12|16=16         bits of the cameras in images of 16 bits a sample
--time auto|header|log=auto  time of capture of an image: as log.time of the settings
"""

# Maps of places, and the height of the cameras.
MAP: Final = """
map of places:
--map FILE.omap [places.map]              localise in a map of places and extend it at the end; a file that does not
    exist is made; the points of the 3-D map are written by `omnid replay --cloud FILE.ply`
--localize-only [places.localize_only]    leave the map as it is
"""
HEIGHT: Final = """
--height-m M 0.1..10  height of the lower viewpoint (the focus of the lower mirror) above the floor; without it `omnid
                      calibrate drive` finds it by the floor
"""


def device_opener(config: Config) -> Callable[[Camera], V4l2Camera]:
    """Return what opens a camera of the settings; its events are logged."""
    from drivers.cameras.v4l2_camera import V4l2Camera

    return lambda camera: V4l2Camera(config.cameras.settings(camera), camera, on_event=log)


def failed(line: str) -> int:
    """Log why the command has no result; return its exit code, 1."""
    log(logging.ERROR, line)
    return 1


def print_entries(entries: Mapping[str, object]) -> None:
    """Print a line for each entry that is not empty: its name, padded, and its value."""
    for name, value in entries.items():
        if value != "":
            print(f"{name:<12} {value}")


def print_json(value: object) -> None:
    """Print dataclasses, mappings, sequences and numbers; a number that is not finite becomes null."""
    # JSON has neither mappings that are no dict, nor paths.
    encoded = msgspec.json.encode(value, enc_hook=lambda one: dict(one) if isinstance(one, Mapping) else str(one))
    print(msgspec.json.format(encoded, indent=2).decode())
