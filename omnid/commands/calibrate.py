"""`omnid calibrate`: calibration of cameras and rigs, checks of a rig, import and export of other formats."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Final

ACTIONS: Final = (
    "board",
    "camera",
    "live",
    "rig",
    "check",
    "drive",
    "height",
    "mask",
    "files",
)  # files: import, export


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `calibrate` with its actions to the command line."""
    actions = add_listed(subparsers).add_subparsers(
        dest="action", required=True, metavar="board|live|camera|rig|check|drive|height|mask|import|export"
    )
    for name in ACTIONS:
        import_module(f"omnid.commands.calibrate_{name}").add_parser(actions)


def add_listed(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Add `calibrate` without its actions, whose modules take half a second to import: for the list of commands."""
    return subparsers.add_parser("calibrate", help="make a camera.toml or a rig.toml, or other programs' files")
