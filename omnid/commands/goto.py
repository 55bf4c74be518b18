"""`omnid goto`: drive a robot to a pose."""

from __future__ import annotations

import argparse
import math
from functools import partial

from omnid.commands.config import add_settings
from omnid.commands.listen import add_robot, config_of
from omnid.errors import OmnidError

FARTHEST_M = 1e6


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `goto` to the command line."""
    parser = subparsers.add_parser(
        "goto",
        help="drive a robot to a pose, around obstacles",
        description="Drive an armed robot to a pose of its base and wait for the end; "
        "Ctrl-C, or a terminal that closes, cancels, and it stops. Exit code 0: reached, 1: not reached.",
    )
    parser.add_argument(
        "pose",
        type=float,
        nargs="*",
        metavar="X Y [YAW]",
        help="m, m, and deg counter-clockwise; without YAW the heading stays as it comes",
    )
    parser.add_argument(
        "--frame",
        choices=("odom", "map"),
        default="odom",
        help="frame of the pose: odom begins at the robot's start, map is that of its saved map; default %(default)s",
    )
    verbs = parser.add_mutually_exclusive_group()
    verbs.add_argument("--cancel", action="store_const", dest="verb", const="cancel", help="end what is under way")
    verbs.add_argument("--pause", action="store_const", dest="verb", const="pause", help="halt")
    verbs.add_argument(
        "--resume",
        action="store_const",
        dest="verb",
        const="resume",
        help="go on after a halt or a fault; it arms the robot, too",
    )
    parser.add_argument("--no-wait", action="store_true", help="end as soon as the robot has accepted it")
    add_robot(parser)
    add_settings(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Drive, or cancel, pause, resume."""
    from omnid.monitor.navigation import connected, drive_to_end, granted

    if args.verb and args.pose:
        raise OmnidError(f"goto: --{args.verb} takes no pose: leave one of them out")
    if not args.verb and len(args.pose) not in (2, 3):
        raise OmnidError(f"goto: expected X Y [YAW], numbers found: {len(args.pose)}")
    if not all(math.isfinite(value) and abs(value) <= FARTHEST_M for value in args.pose):
        raise OmnidError(f"goto: expected finite numbers of at most {FARTHEST_M:g}")
    with connected(config_of(args).bus) as robot:
        driver = robot.driver()
        if args.verb == "resume":
            granted(robot, driver.arm())
        if args.verb:
            print(granted(robot, driver.navigate(args.verb)))
            return 0
        heading_rad = math.radians(args.pose[2]) if len(args.pose) == 3 else None
        ask = partial(driver.goal, args.pose[0], args.pose[1], heading_rad, args.frame)
        if not args.no_wait:
            return drive_to_end(robot, driver, ask)
        granted(robot, ask())
        return 0
