"""`omnid config`: print settings as a file to start from, or check a file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.config import Config


@command(
    option("action", nargs="?", choices=("print", "check"), default="print", help="default: print"),
    option("file", nargs="?", type=Path, metavar="FILE", help="of check"),
    option(
        "--minimal",
        action="store_true",
        help="print only what differs from the defaults, and what a new robot needs; all other defaults stay those of "
        "the installed version",
    ),
    *SETTINGS,
    examples=("config --minimal > omnid.toml", "config check omnid.toml"),
    description="Print all settings with their defaults as TOML; or check a file.",
)
def run(args: argparse.Namespace) -> int:
    """Print or check settings."""
    from omnid.config import FIRST_SETTINGS
    from omnid.settings import dump, dump_minimal

    if (args.action == "print") != (args.file is None):
        raise OmnidError(
            f"omnid config {args.action}: "
            + (
                "name the file"
                if args.file is None
                else f"takes no file: `omnid config --config {args.file}` prints its settings"
            )
        )
    args.config = args.file or args.config
    config = settings_of(args)
    if args.action == "check":
        _require_usable(config)
        print("\n".join(_differences(config, str(args.file))))
    else:
        print(dump_minimal(config, FIRST_SETTINGS) if args.minimal else dump(config), end="")
    return 0


def _require_usable(config: Config) -> None:
    """Raise OmnidError or DriverError for words that only the daemon's start would refuse."""
    from drivers.motors.protocols.protocol_registry import motor_protocol
    from omnid.transport.bus_config import checked

    checked(config.bus)
    motor_protocol(config.motor.protocol)


def _differences(config: Config, name: str) -> list[str]:
    """Return a line about the file, and one for each setting that differs from its default."""
    from omnid.config import Config
    from omnid.settings import changed, value_at

    paths = changed(config)
    lines = [f"{path} = {value_at(config, path)!r}, default {value_at(Config(), path)!r}" for path in paths]
    return [f"{name}: good; {len(paths)} settings differ from their defaults", *lines]
