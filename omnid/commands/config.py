"""`omnid config`: print all settings with their defaults, as a file to start from."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `config` to the command line."""
    parser = subparsers.add_parser("config", help="print all settings with their defaults, as TOML")
    add_settings(parser)
    parser.set_defaults(run=run)


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the options --config and --set."""
    parser.add_argument("--config", type=Path, metavar="FILE",
                        help="TOML file of settings; `omnid config` prints the defaults")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", dest="overrides",
                        help="a setting that replaces that of the file; may be repeated")


def run(args: argparse.Namespace) -> int:
    """Print the settings."""
    from omnid.config import load_config
    from omnid.settings import dump

    print(dump(load_config(args.config, args.overrides)), end="")
    return 0
