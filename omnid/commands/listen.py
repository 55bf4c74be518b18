"""`omnid listen`: show the state of a robot, local or remote, line by line or as a table."""

from __future__ import annotations

import argparse

from omnid.commands.options import ROBOT, SECONDS, SETTINGS, check_seconds, command, settings_of


@command(
    *ROBOT,
    SECONDS,
    *SETTINGS,
    examples=("listen", "listen --robot rover --connect tcp/robot:7447 --seconds 60"),
)
def run(args: argparse.Namespace) -> int:
    """Show the robot until the end; return 1 if no pose was received."""
    from omnid.monitor.listen import listen

    check_seconds(args.seconds)
    return listen(settings_of(args).bus, args.seconds)
