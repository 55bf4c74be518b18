"""`omnid listen`: show the state of a robot, local or remote, line by line or as a table."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.config import add_settings, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:
    from omnid.config import Config


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `listen` to the command line."""
    parser = subparsers.add_parser("listen", help="show pose, state, rates and latencies of a robot, and record them")
    add_robot(parser)
    parser.add_argument("--load", action="store_true", help="the share of a core that each thread of the robot takes")
    parser.add_argument("--tum", type=Path, metavar="FILE", help="write the poses in the TUM format")
    parser.add_argument("--mcap", type=Path, metavar="FILE", help="record all received messages to a log")
    parser.add_argument("--seconds", type=float, metavar="N", help="end after N seconds; default: on Ctrl-C")
    add_settings(parser)
    parser.set_defaults(run=run)


def add_robot(parser: argparse._ActionsContainer, more: str = "") -> None:
    """Add the options --robot and --connect. more: the end of the help of --robot."""
    parser.add_argument("--robot", metavar="NAME", help=f"its name; default: bus.robot of the settings{more}")
    parser.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="the robot or a router, such as "
        "tcp/robot:7447; default: bus.connect of the settings, without them this machine",
    )


def config_of(args: argparse.Namespace) -> Config:
    """Return the configuration with the robot's name and endpoints of --robot and --connect."""
    config = settings_of(args)
    robot, connect = args.robot or config.bus.robot, tuple(args.connect or config.bus.connect)
    return replace(config, bus=replace(config.bus, robot=robot, connect=connect))


def check_seconds(seconds: float | None) -> None:
    """Raise OmnidError where the value of --seconds is no duration."""
    if seconds is not None and not 0 < seconds < 1e9:
        raise OmnidError(f"--seconds {seconds} is not a duration: expected seconds above 0")


def run(args: argparse.Namespace) -> int:
    """Show the robot until the end; return 1 if no pose was received."""
    from omnid.monitor.follow import listen

    check_seconds(args.seconds)
    return listen(config_of(args).bus, args.tum, args.mcap, args.seconds, shows_load=args.load)
