"""`omnid drive`: drive a robot by the keyboard, on this machine or from another."""

from __future__ import annotations

import argparse

from omnid.commands.config import add_settings
from omnid.commands.listen import add_robot, config_of


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `drive` to the command line."""
    parser = subparsers.add_parser(
        "drive",
        help="drive a robot by the keyboard",
        description="Drive a robot by the arrow keys. A motion lasts as long as its key is "
        "held: terminals repeat keys, and 0.6 s after the last one the wheels stop. Space "
        "stops them until `a` arms the robot. Speeds are shares of the robot's own limits.",
    )
    add_robot(parser)
    add_settings(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Drive until `q`."""
    from omnid.monitor.teleop import teleoperate

    return teleoperate(config_of(args).bus)
