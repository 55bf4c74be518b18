"""Commands to a robot over the bus: `omnid arm`, `stop`, `drive`, `goto`, `route`; its routes on this computer."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from omnid.commands.options import JSON, ROBOT, SETTINGS, command, exclusive, option, print_json, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.client import Answer, Driver, Robot
    from omnid.core.navigation.route import Route
    from omnid.formats.route_file import RouteFolder

NAME: Final = option("name", metavar="NAME", help="letters, digits, '-' and '_'")
NO_WAIT: Final = option("--no-wait", action="store_true", help="end as soon as the robot has accepted it")


@command(*ROBOT, *SETTINGS, examples=("arm", "arm --robot rover --connect tcp/robot:7447"))
def arm(args: argparse.Namespace) -> int:
    """Arm the robot; return 1 if it refuses."""
    with _connected(args) as robot:
        answer = robot.driver().arm()
    print(f"{robot.name} is {answer.text}" if answer.done else f"{robot.name} refuses: {answer.text}")
    return int(not answer.done)


@command(*ROBOT, *SETTINGS, examples=("stop", "stop --robot rover --connect tcp/robot:7447"))
def stop(args: argparse.Namespace) -> int:
    """Stop the robot; return 1 if it has not confirmed that."""
    from omnid.monitor.navigation import stop as stop_robot

    bus = settings_of(args).bus
    if stop_robot(bus):
        print(f"{bus.robot} stops: its wheels stay stopped until `omnid arm`")
        return 0
    print(f"{bus.robot} has not confirmed the stop: use the emergency stop if it drives")
    return 1


@command(
    *ROBOT,
    *SETTINGS,
    examples=("drive", "drive --robot rover --connect tcp/robot:7447"),
    description="Drive a robot by the arrow keys. A motion lasts as long as its key is held: terminals repeat keys, "
    "and 0.6 s after the last one the wheels stop. Space stops them until `a` arms the robot. Speeds are shares of the "
    "robot's own limits.",
)
def drive(args: argparse.Namespace) -> int:
    """Drive until `q`."""
    from omnid.monitor.teleop import teleoperate

    return teleoperate(settings_of(args).bus)


@command(
    option(
        "pose",
        type=float,
        nargs="*",
        metavar="X Y [YAW]",
        help="m, m, and deg counter-clockwise; without YAW the heading stays as it comes",
    ),
    option(
        "--frame",
        choices=("odom", "map"),
        default="odom",
        help="frame of the pose: odom begins at the robot's start, map is that of its saved map; default %(default)s",
    ),
    exclusive(
        option("--cancel", action="store_const", dest="verb", const="cancel", help="end what is under way"),
        option("--pause", action="store_const", dest="verb", const="pause", help="halt"),
        option(
            "--resume",
            action="store_const",
            dest="verb",
            const="resume",
            help="go on after a halt or a fault; it arms the robot, too",
        ),
    ),
    NO_WAIT,
    *ROBOT,
    *SETTINGS,
    examples=("goto 3 1.5 90", "goto -1.2 0.5 --frame map --robot rover --connect tcp/robot:7447", "goto --cancel"),
    description="Drive an armed robot to a pose of its base and wait for the end; Ctrl-C, or a terminal that closes, "
    "cancels, and it stops. Exit code 0: reached, 1: not reached.",
)
def goto(args: argparse.Namespace) -> int:
    """Drive, or cancel, pause, resume."""
    from omnid.monitor.navigation import granted

    if args.verb and args.pose:
        raise OmnidError(f"goto: --{args.verb} takes no pose: leave one of them out")
    if not args.verb and len(args.pose) not in (2, 3):
        raise OmnidError(f"goto: expected X Y [YAW], numbers found: {len(args.pose)}")
    if not all(map(math.isfinite, args.pose)):
        raise OmnidError(f"goto: expected finite numbers, found {' '.join(map(str, args.pose))}")
    with _connected(args) as robot:
        driver = robot.driver()
        if not args.verb:
            heading_rad = math.radians(args.pose[2]) if len(args.pose) == 3 else None
            ask = partial(driver.goal, args.pose[0], args.pose[1], heading_rad, args.frame)
            return _begin(args, robot, driver, ask)
        if args.verb == "resume":
            granted(robot, driver.arm())
        print(granted(robot, driver.navigate(args.verb)))
        return 0


@command(
    NAME,
    option(
        "--replace",
        action="store_true",
        help="in the place of a route of that name, which stays until the new one is written; without it an existing "
        "name is refused",
    ),
    option("--no-wait", action="store_true", help="end at once: `omnid route finish` writes it"),
    *ROBOT,
    *SETTINGS,
    examples=("route teach morning", "route teach morning --replace"),
)
def teach(args: argparse.Namespace) -> int:
    """Record until Enter is pressed; Ctrl-C drops the recording."""
    from omnid.core.navigation.requests import route_name
    from omnid.monitor.navigation import granted, record_until_enter

    name = route_name(args.name)
    with _connected(args) as robot:
        granted(robot, robot.driver().route(f"teach {name} replace" if args.replace else f"teach {name}"))
        if args.no_wait:
            print(f"records {name}: drive it, then `omnid route finish`")
            return 0
        return record_until_enter(robot, name)


@command(
    NAME,
    option("--reverse", action="store_true", help="from its end to its start"),
    option(
        "--loops",
        type=int,
        default=1,
        metavar="N",
        help="a closed route is driven in rounds, another there and back, N times in all; default %(default)s",
    ),
    option(
        "--from",
        choices=("here", "start"),
        default="here",
        dest="begin",
        help="here: from where the robot is on the route, anywhere within 1.5 m of it; start: the whole route, refused "
        "elsewhere; default %(default)s",
    ),
    NO_WAIT,
    *ROBOT,
    *SETTINGS,
    examples=("route repeat morning", "route repeat morning --reverse --loops 5 --no-wait"),
)
def repeat(args: argparse.Namespace) -> int:
    """Repeat a route; return 0 if its end is reached, else 1."""
    from omnid.core.navigation.requests import MAX_LOOPS, route_name

    if not 1 <= args.loops <= MAX_LOOPS:
        raise OmnidError(f"--loops {args.loops}: expected 1 to {MAX_LOOPS}")
    words = ["repeat", route_name(args.name), *(["reverse"] if args.reverse else [])]
    text = " ".join([*words, f"loops={args.loops}", f"from={args.begin}"])
    with _connected(args) as robot:
        driver = robot.driver()
        return _begin(args, robot, driver, partial(driver.route, text))


@command(*ROBOT, *SETTINGS, examples=("route finish",))
def finish(args: argparse.Namespace) -> int:
    """Have the recorded route written, and print the robot's answer."""
    return _ask_for_route(args, "finish")


@command(*ROBOT, *SETTINGS, examples=("route stop",))
def end_route(args: argparse.Namespace) -> int:
    """End the repetition or the recording, and print the robot's answer."""
    return _ask_for_route(args, "stop")


@command(*SETTINGS, JSON, examples=("route list", "route list --json"))
def list_routes(args: argparse.Namespace) -> int:
    """Print the routes; return 2 if a file is damaged."""
    folder, code, found = _folder(args), 0, []
    for name in folder.names():
        try:
            found.append(folder.read(name))
        except OmnidError as error:
            print(f"omnid: {error}", file=sys.stderr)
            code = 2
    if args.json:
        print_json([_summary(route) for route in found])
    elif not found and not code:
        print(f"no routes in {folder.folder}: teach one (`omnid route teach NAME`)")
    else:
        for route in found:
            print(f"{route.name:<20} {route.length_m:8.1f} m  {_time(route)}  {route.map_name}")
    return code


@command(
    NAME,
    option("--tum", type=Path, metavar="FILE", help="write its poses in the TUM format"),
    *SETTINGS,
    JSON,
    examples=("route show morning --tum morning.txt",),
)
def show_route(args: argparse.Namespace) -> int:
    """Print a route; with --tum, write its poses to a file as well."""
    import numpy as np

    from calib.se2_arrays import transform
    from omnid.sinks.files import check_outputs, write_trajectory

    folder = _folder(args)
    route = folder.read(args.name)
    if args.tum:
        check_outputs([("--tum", args.tum)], [("the route that is read", folder.path(args.name))])
        # A route has speeds and no times. Where the robot nearly stood, 0.1 m/s keeps the times finite.
        steps_m = np.hypot(*np.diff(route.poses[:, :2], axis=0).T)
        times_s = np.concatenate([[0.0], np.cumsum(steps_m / np.maximum(np.abs(route.speeds[1:]), 0.1))])
        write_trajectory(
            args.tum, np.round(times_s * 1e9).astype(np.int64), np.array([transform(pose) for pose in route.poses])
        )
    summary = _summary(route)
    if args.json:
        rows = zip(route.poses.tolist(), route.speeds.tolist(), strict=True)
        print_json({**summary, "points": [[*pose, speed] for pose, speed in rows]})
        return 0
    for key in ("name", "map", "length_m", "points", "keyframes", "closed"):
        print(f"{key:<12} {summary[key] if key != 'length_m' else round(route.length_m, 2)}")
    print(f"{'taught':<12} {_time(route)}")
    (x, y, _), (end_x, end_y, _) = route.poses[0], route.poses[-1]
    print(f"{'from, to':<12} {x:.2f} {y:.2f}, {end_x:.2f} {end_y:.2f} m in the map")
    return 0


@command(NAME, *SETTINGS, examples=("route delete morning",))
def delete_route(args: argparse.Namespace) -> int:
    """Delete a route."""
    _folder(args).delete(args.name)
    print(f"deleted: {args.name}")
    return 0


def _connected(args: argparse.Namespace) -> Robot:
    from omnid.monitor.navigation import connected

    return connected(settings_of(args).bus)


def _begin(args: argparse.Namespace, robot: Robot, driver: Driver, ask: Callable[[], Answer]) -> int:
    """Ask for a drive and show it until its end, or with --no-wait until the robot has accepted it."""
    from omnid.monitor.navigation import drive_to_end, granted

    if not args.no_wait:
        return drive_to_end(robot, driver, ask)
    granted(robot, ask())
    return 0


def _ask_for_route(args: argparse.Namespace, words: str) -> int:
    from omnid.monitor.navigation import granted

    with _connected(args) as robot:
        print(granted(robot, robot.driver().route(words)))
    return 0


def _folder(args: argparse.Namespace) -> RouteFolder:
    from omnid.formats.route_file import RouteFolder

    return RouteFolder(Path(settings_of(args).navigation.routes))


def _summary(route: Route) -> dict[str, object]:
    """Return the values that `list --json` and `show` print of a route."""
    return {
        "name": route.name,
        "map": route.map_name,
        "created_s": route.created_s,
        "length_m": route.length_m,
        "points": len(route.poses),
        "keyframes": len(route.stamps_ns),
        "closed": route.is_closed,
    }


def _time(route: Route) -> str:
    return f"{datetime.fromtimestamp(route.created_s, UTC):%Y-%m-%d %H:%M} UTC"
