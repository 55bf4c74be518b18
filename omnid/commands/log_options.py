"""The options --lower and --upper, which name the cameras, and the rig that is attached to a log."""

from __future__ import annotations

import argparse
from contextlib import closing
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


def attached_rig_of(args: argparse.Namespace) -> Rig:
    """Return the rig that is attached to args.log. Raise OmnidError if there is none."""
    from drivers.logs.log_reader import LogReader
    from omnid.runs.log_rig import attached_rig

    with closing(LogReader(args.log, args.lower, args.upper)) as reader:
        return attached_rig(reader, args.log)
