"""Commands and options of the command line: each option is declared once, and a command lists those that it takes.

    @command(LOG, RIG, option("--seconds", type=float, help="read so many seconds only"), examples=("replay a.mcap",))
    def run(args: argparse.Namespace) -> int: ...

`omnid/cli.py` names the module of each command. An option with `setting="motor.port"` stands for that setting:
`settings_of(args)` returns the configuration with all of them. At the end: how commands print warnings and JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, TextIO, TypeAlias

from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from drivers.cameras.v4l2_camera import V4l2Camera
    from drivers.frame import Camera
    from drivers.logs.log_reader import LogCameras
    from omnid.config import Config

PROFILES: Final = {
    "small": ("panorama.scale=0.5", "odometry.limits.features=250"),
}
_NO_SETTINGS: Final[Mapping[str, object]] = MappingProxyType({})
_EXAMPLES: Final = "examples:"  # the first line of an epilog


Run: TypeAlias = Callable[[argparse.Namespace], int]
Option: TypeAlias = Callable[[argparse._ActionsContainer], None]  # adds an option, or several, to a parser


@dataclass(frozen=True, slots=True)
class Command:
    """A command without subcommands: what it takes and what it does."""

    run: Run
    options: tuple[Option, ...]
    examples: tuple[str, ...]  # without `omnid`; a test parses them all
    description: str  # "": its line in the list of commands

    def add_to(self, parser: argparse.ArgumentParser, help: str) -> None:
        """Give a parser the options and the help of this command. help: its line in the list of commands."""
        for add in self.options:
            add(parser)
        parser.formatter_class = _ExamplesFormatter
        parser.description = self.description or f"{help[:1].upper()}{help[1:]}."
        parser.epilog = "\n".join((_EXAMPLES, *(f"  omnid {example}" for example in self.examples)))
        parser.set_defaults(command=self, actions=parser._actions)


class _ExamplesFormatter(argparse.HelpFormatter):
    """Leaves the lines of the examples as they are, so that they can be copied; wraps all other text."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith(_EXAMPLES):
            return "".join(indent + line for line in text.splitlines(keepends=True))
        return super()._fill_text(text, width, indent)


def option(*names: str, setting: str = "", **keywords: Any) -> Option:
    """Declare an option or a positional argument; the keywords are those of argparse's add_argument.

    setting: dotted path of the setting that it stands for; "": none.
    """

    def add(parser: argparse._ActionsContainer) -> None:
        parser.add_argument(*names, **keywords).setting = setting  # type: ignore[attr-defined]  # read by settings_of

    return add


def group(title: str | None, *options: Option) -> Option:
    """Declare options that stand under a title of their own in the help; None: of which at most one may be given."""

    def add(parser: argparse._ActionsContainer) -> None:
        below = parser.add_mutually_exclusive_group() if title is None else parser.add_argument_group(title)
        for add_one in options:
            add_one(below)

    return add


exclusive: Final = partial(group, None)


def command(*options: Option, examples: tuple[str, ...], description: str = "") -> Callable[[Run], Command]:
    """Make a command of a function from parsed arguments to the exit code."""
    return lambda run: Command(run, options, examples, description)


def settings_of(args: argparse.Namespace, more: Mapping[str, object] = _NO_SETTINGS) -> Config:
    """Return the configuration of --config, --profile, --set, and of the options that stand for a setting.

    more: further settings by their names, None: not given; they win over the options.
    """
    from omnid.config import load_config

    named = {action.setting: getattr(args, action.dest) for action in args.actions if getattr(action, "setting", "")}
    # As --set takes them.
    given = [
        f"{path}={json.dumps(value) if isinstance(value, bool | list) else value}"
        for path, value in (named | dict(more)).items()
        if not (value is None or value is False)
    ]
    profile = PROFILES[args.profile] if getattr(args, "profile", None) else ()
    return load_config(args.config, [*profile, *args.overrides, *given])


# Settings of any command.
CONFIG: Final = option(
    "--config", type=Path, metavar="FILE", help="TOML file of settings; `omnid config` prints the defaults"
)
SET: Final = option(
    "--set",
    action="append",
    default=[],
    metavar="SECTION.KEY=VALUE",
    dest="overrides",
    help="a setting that replaces that of the file; may be repeated",
)
SETTINGS: Final = (
    CONFIG,
    option(
        "--profile",
        choices=tuple(PROFILES),
        help="settings that replace those of the file; small: half-size panoramas and half the landmarks, for a small "
        "computer",
    ),
    SET,
)
JSON: Final = option("--json", action="store_true", help="print the result as JSON")
QUIET: Final = option("--quiet", action="store_true", help="do not show the progress")

# A robot on the bus.
ROBOT: Final = (
    option("--robot", metavar="NAME", setting="bus.robot", help="its name; default: bus.robot of the settings"),
    option(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        setting="bus.connect",
        help="the robot or a router, such as tcp/robot:7447; default: bus.connect of the settings, without them this "
        "machine",
    ),
)
SECONDS: Final = option("--seconds", type=float, metavar="N", help="end after N seconds; default: on Ctrl-C")


def check_seconds(seconds: float | None) -> None:
    """Raise OmnidError where the value of --seconds is no duration."""
    if seconds is not None and not 0 < seconds < 1e9:
        raise OmnidError(f"--seconds {seconds} is not a duration: expected seconds above 0")


# A log, its cameras and its rig.
RIG: Final = option("--rig", type=Path, help="the rig.toml of the cameras; default: that attached to the log")
RATE: Final = option(
    "--rate",
    type=float,
    metavar="HZ",
    setting="log.rate_hz",
    help="images per second of folders of images; default: by their names in nanoseconds, or the seconds in times.txt",
)
BITS: Final = option(
    "--bits",
    type=int,
    choices=(8, 10, 12, 16),
    default=16,
    help="bits of the cameras in images of 16 bits a sample; default: 16",
)
LOG_TIME: Final = option(
    "--time",
    choices=("auto", "header", "log"),
    default="auto",
    help="when an image was taken: as log.time of the settings; default: auto",
)
TRUTH: Final = option("--truth", type=Path, metavar="FILE", help="the true path of the rig, TUM format")


def cameras(
    text: str = "images of the {camera} camera; default: found by name",
    metavar: str = "TOPIC",
    *,
    are_settings: bool = False,
) -> tuple[Option, Option]:
    """Declare --lower and --upper.

    text: the help of each. metavar: what they name. are_settings: they stand for cameras.lower and cameras.upper.
    """
    lower, upper = (
        option(
            f"--{camera}",
            metavar=metavar,
            setting=f"cameras.{camera}" if are_settings else "",
            help=text.format(camera=camera),
        )
        for camera in ("lower", "upper")
    )
    return lower, upper


def log_cameras(args: argparse.Namespace) -> LogCameras:
    """Return the cameras of a log by --lower, --upper, --bits, --rate and --time."""
    from drivers.logs.log_reader import LogCameras

    return LogCameras(args.lower, args.upper, args.bits, args.rate or 0.0, args.time)


def device_opener(config: Config) -> Callable[[Camera], V4l2Camera]:
    """Return what opens a camera of the settings; its events are logged. Raise OmnidError unless there are two."""
    from drivers.cameras.v4l2_camera import V4l2Camera
    from omnid.engine.logging_setup import log

    config.cameras.require_two_devices()
    return lambda camera: V4l2Camera(config.cameras.settings(camera), camera, on_event=log)


# Maps of places.
def map_file(text: str) -> Path:
    """Return the map of places of an option; ArgumentTypeError for the name of another kind of map."""
    if text.endswith(".ply"):
        raise argparse.ArgumentTypeError(
            f"{text}: expected a map of places (.omap) to localise in; the points of the 3-D map are written by "
            "--cloud FILE.ply"
        )
    return Path(text)


MAP: Final = group(
    "map of places",
    option(
        "--map",
        type=map_file,
        metavar="FILE.omap",
        setting="places.map",
        help="localise in a map of places and extend it at the end; a file that does not exist is made; the points of "
        "the 3-D map are written by `omnid replay --cloud FILE.ply`",
    ),
    option("--localize-only", action="store_true", setting="places.localize_only", help="leave the map as it is"),
)
REPLACE: Final = option("--replace", action="store_true", help="replace it, with all places that routes refer to")


def warn(line: str) -> None:
    """Print a warning on stderr."""
    print(f"omnid: warning: {line}", file=sys.stderr)


def print_json(value: object, stream: TextIO | None = None) -> None:
    """Print dataclasses, mappings, sequences and numbers; a number that is not finite becomes null."""
    print(json.dumps(_plain(value), indent=2, allow_nan=False), file=stream or sys.stdout)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if hasattr(value, "_asdict"):  # a NamedTuple
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Enum):
        return value.value
    return value
