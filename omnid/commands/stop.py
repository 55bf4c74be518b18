"""`omnid stop`: stop the wheels of a robot until it is armed again."""

from __future__ import annotations

import argparse

from omnid.commands.config import add_settings
from omnid.commands.listen import add_robot, config_of


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `stop` to the command line."""
    parser = subparsers.add_parser("stop", help="stop the wheels until `omnid arm`; everyone who can connect may")
    add_robot(parser)
    add_settings(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Stop the robot; return 1 if it has not confirmed that."""
    from omnid.monitor.stopping import stop

    bus = config_of(args).bus
    if stop(bus):
        print(f"{bus.robot} stops: its wheels stay stopped until `omnid arm`")
        return 0
    print(f"{bus.robot} has not confirmed the stop: use the emergency stop if it drives")
    return 1
