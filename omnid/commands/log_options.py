"""The options that name a log, its cameras and its rig, and the rig that they name."""

from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the help does not load it
    from calib.rig import Rig


def add_cameras(
    parser: argparse._ActionsContainer,
    text: str = "images of the {camera} camera; default: found by name",
    metavar: str = "TOPIC",
) -> None:
    """Add --lower and --upper. text: the help of each. metavar: what they name."""
    for camera in ("lower", "upper"):
        parser.add_argument(f"--{camera}", metavar=metavar, help=text.format(camera=camera))


def add_log_with_rig(parser: argparse._ActionsContainer, text: str) -> None:
    """Add LOG, --rig, --lower and --upper. text: the help of LOG."""
    parser.add_argument("log", type=Path, metavar="LOG", help=text)
    parser.add_argument("--rig", type=Path, metavar="FILE", help="the rig.toml; default: the one attached to the log")
    add_cameras(parser, "the {camera} camera's topic")


def rig_of(args: argparse.Namespace) -> Rig:
    """Return the rig of args.rig, or the one that is attached to args.log. Raise OmnidError if there is none."""
    from calib.rig_file import read_rig

    return read_rig(args.rig) if args.rig else attached_rig_of(args)


def attached_rig_of(args: argparse.Namespace) -> Rig:
    """Return the rig that is attached to args.log. Raise OmnidError if there is none."""
    from drivers.logs.log_reader import LogReader
    from omnid.runs.log_rig import attached_rig

    with closing(LogReader(args.log, args.lower, args.upper)) as reader:
        return attached_rig(reader, args.log)
