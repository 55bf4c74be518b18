"""`omnid arm`: let the wheels of a robot turn, after its start, a stop or a fault."""

from __future__ import annotations

import argparse

from omnid.commands.config import add_settings
from omnid.commands.listen import add_robot, config_of


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `arm` to the command line."""
    parser = subparsers.add_parser("arm", help="let the wheels turn, after the robot's start, a stop or a fault")
    add_robot(parser)
    add_settings(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Arm the robot; return 1 if it refuses."""
    from omnid.monitor.navigation import connected

    with connected(config_of(args).bus) as robot:
        answer = robot.driver().arm()
    print(f"{robot.name} is {answer.text}" if answer.done else f"{robot.name} refuses: {answer.text}")
    return int(not answer.done)
