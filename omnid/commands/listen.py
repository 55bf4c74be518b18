"""`omnid listen`: show the state of a robot, local or remote, line by line or as a table."""

from __future__ import annotations

import argparse
from pathlib import Path

from omnid.commands.options import ROBOT, SECONDS, SETTINGS, check_seconds, command, option, settings_of


@command(
    *ROBOT,
    option("--load", action="store_true", help="the share of a core that each thread of the robot takes"),
    option("--tum", type=Path, metavar="FILE", help="write the poses in the TUM format"),
    option("--mcap", type=Path, metavar="FILE", help="record all received messages to a log"),
    SECONDS,
    *SETTINGS,
    examples=(
        "listen",
        "listen --robot rover --connect tcp/robot:7447 --tum path.txt --mcap received.mcap",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Show the robot until the end; return 1 if no pose was received."""
    from omnid.monitor.listen import listen

    check_seconds(args.seconds)
    return listen(settings_of(args).bus, args.tum, args.mcap, args.seconds, shows_load=args.load)
