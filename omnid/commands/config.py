"""`omnid config`: print settings as a file to start from, check a file, or rewrite one of an earlier version."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.config import Config

PROFILES: Final = {
    "small": ("panorama.scale=0.5", "odometry.limits.features=250"),
}
_NO_SHORTCUTS: Final[Mapping[str, object]] = MappingProxyType({})


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `config` to the command line."""
    parser = subparsers.add_parser(
        "config",
        help="print, check or migrate settings",
        description="Print all settings with their defaults as TOML; check or migrate a file.",
    )
    parser.add_argument(
        "action", nargs="?", choices=("print", "check", "migrate"), default="print", help="default: print"
    )
    parser.add_argument("file", nargs="?", type=Path, metavar="FILE", help="of check and migrate")
    parser.add_argument(
        "--minimal",
        action="store_true",
        help="print only what differs from the defaults, and what "
        "a new robot needs; all other defaults stay those of the installed version",
    )
    add_settings(parser)
    parser.set_defaults(run=run)


class ChooseProfile(argparse.Action):
    """Settings of a profile, as if --set came before all others."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Add the settings."""
        namespace.overrides = [*PROFILES[str(values)], *namespace.overrides]


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the options --config, --profile and --set."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML file of settings; `omnid config` prints the defaults"
    )
    parser.add_argument(
        "--profile",
        action=ChooseProfile,
        choices=tuple(PROFILES),
        default=argparse.SUPPRESS,
        help="settings that replace those of the file; small: half-size panoramas and half the "
        "landmarks, for a small computer",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        dest="overrides",
        help="a setting that replaces that of the file; may be repeated",
    )


def settings_of(args: argparse.Namespace, shortcuts: Mapping[str, object] = _NO_SHORTCUTS) -> Config:
    """Return the configuration of --config, --profile and --set.

    shortcuts: values of options that stand for a setting, by its name; None: the option is not given.
    """
    from omnid.config import load_config

    given = [f"{key}={value}" for key, value in shortcuts.items() if value is not None]
    return load_config(args.config, [*args.overrides, *given])


def run(args: argparse.Namespace) -> int:
    """Print, check or migrate settings."""
    from omnid.config import FIRST_SETTINGS, load_config, migrated_config
    from omnid.settings_dump import dump, dump_minimal

    if (args.action == "print") != (args.file is None):
        raise OmnidError(
            f"omnid config {args.action}: "
            + (
                "name the file"
                if args.file is None
                else f"takes no file: `omnid config --config {args.file}` prints its settings"
            )
        )
    if args.action == "migrate":
        config, renamed = migrated_config(args.file)
        print(dump_minimal(config, ()), end="")
        for line in renamed:
            print(f"omnid: {line}", file=sys.stderr)
        print(
            f"omnid: {args.file} is as it was; comments and settings with their default value are left out here: "
            f"`omnid config migrate {args.file} > NEW.toml` makes a file",
            file=sys.stderr,
        )
        return 0
    config = load_config(args.file or args.config, args.overrides)
    if args.action == "check":
        print("\n".join(_differences(config, str(args.file))))
    else:
        print(dump_minimal(config, FIRST_SETTINGS) if args.minimal else dump(config), end="")
    return 0


def _differences(config: Config, name: str) -> list[str]:
    """Return a line about the file, and one for each setting that differs from its default."""
    from omnid.config import Config
    from omnid.settings import changed, value_at

    paths = changed(config)
    lines = [f"{path} = {value_at(config, path)!r}, default {value_at(Config(), path)!r}" for path in paths]
    return [f"{name}: good; {len(paths)} settings differ from their defaults", *lines]
