"""Commands to a robot over the bus: `omnid arm`, `stop`, `drive`, `goto`, `route`; its routes on this computer."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from omnid.commands.options import JSON, ROBOT, SETTINGS, command, print_entries, print_json, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help and other commands do not load these
    from omnid.client import Answer, Driver
    from omnid.core.navigation.route import Route
    from omnid.formats.route_file import RouteFolder

NAME: Final = "name NAME  letters, digits, '-' and '_'"
NO_WAIT: Final = "--no-wait  end as soon as the robot has accepted it"


@command(ROBOT, SETTINGS)
def arm(args: argparse.Namespace) -> int:
    """Let the wheels turn, after the robot's start, a stop or a fault; exit code 1: the robot refuses.

    examples:
      arm
      arm --robot rover --connect tcp/robot:7447
    """
    from omnid.monitor.navigation import connected

    with connected(settings_of(args).bus) as robot:
        answer = robot.driver().arm()
    print(f"{robot.name} is {answer.text}" if answer.done else f"{robot.name} refuses: {answer.text}")
    return int(not answer.done)


@command(ROBOT, SETTINGS)
def stop(args: argparse.Namespace) -> int:
    """Stop the wheels until `omnid arm`; everyone who can connect may. Exit code 1: it has not confirmed that.

    examples:
      stop
      stop --robot rover --connect tcp/robot:7447
    """
    from omnid.monitor.navigation import stop as stop_robot

    bus = settings_of(args).bus
    if stop_robot(bus):
        print(f"{bus.robot} stops: its wheels stay stopped until `omnid arm`")
        return 0
    print(f"{bus.robot} has not confirmed the stop: use the emergency stop if it drives")
    return 1


@command(ROBOT, SETTINGS)
def drive(args: argparse.Namespace) -> int:
    """Drive a robot by the arrow keys.

    A motion lasts as long as its key is held: terminals repeat keys, and 0.6 s after the last one the wheels stop.
    Space stops them until `a` arms the robot. Speeds are shares of the robot's own limits.

    examples:
      drive
      drive --robot rover --connect tcp/robot:7447
    """
    from omnid.monitor.teleop import teleoperate

    return teleoperate(settings_of(args).bus)


@command(NO_WAIT, ROBOT, SETTINGS)
def goto(args: argparse.Namespace) -> int:
    """Drive an armed robot to a pose of its base and wait for the end.

    Ctrl-C, or a terminal that closes, cancels, and it stops. Exit code 0: reached, 1: not reached.

    pose [X]...            X Y [YAW]: m, m, and deg counter-clockwise; without YAW the heading stays as it comes
    --frame odom|map=odom  frame of the pose: odom begins at the robot's start, map is that of its saved map

    one of:
    --cancel  end what is under way
    --pause   halt
    --resume  go on after a halt or a fault; it arms the robot, too

    examples:
      goto 3 1.5 90
      goto -1.2 0.5 --frame map --robot rover --connect tcp/robot:7447
      goto --cancel
    """
    verb = next((verb for verb in ("cancel", "pause", "resume") if getattr(args, verb)), None)
    if verb and args.pose:
        raise OmnidError(f"goto: --{verb} takes no pose: leave one of them out")
    if verb is None and len(args.pose) not in (2, 3):
        raise OmnidError(f"goto: expected X Y [YAW], numbers found: {len(args.pose)}")
    if verb is None:
        heading_rad = math.radians(args.pose[2]) if len(args.pose) == 3 else None
        return _drive(args, lambda driver: driver.goal(args.pose[0], args.pose[1], heading_rad, args.frame))
    return ask(args, *([lambda driver: driver.arm()] if verb == "resume" else []), lambda driver: driver.navigate(verb))


@command(NAME, ROBOT, SETTINGS)
def teach(args: argparse.Namespace) -> int:
    """Record a route while somebody drives (`omnid drive`, a joystick): Enter writes it, Ctrl-C drops it.

    --replace  in the place of a route of that name, which stays until the new one is written; without it an existing
        name is refused
    --no-wait  end at once: `omnid route finish` writes it

    examples:
      route teach morning
      route teach morning --replace
    """
    from omnid.core.navigation.requests import route_name
    from omnid.monitor.navigation import connected, granted, record_until_enter

    name = route_name(args.name)
    with connected(settings_of(args).bus) as robot:
        granted(robot, robot.driver().route(f"teach {name} replace" if args.replace else f"teach {name}"))
        if not args.no_wait:
            return record_until_enter(robot, name)
    print(f"records {name}: drive it, then `omnid route finish`")
    return 0


@command(NAME, NO_WAIT, ROBOT, SETTINGS)
def repeat(args: argparse.Namespace) -> int:
    """Repeat a route, from where the robot is on it; exit code 1: its end was not reached.

    --reverse               from its end to its start
    --loops N=1 1..10000    a closed route is driven in rounds, another there and back, N times in all
    --from here|start=here  here: from where the robot is on the route, anywhere within 1.5 m of it; start: the whole
        route, refused elsewhere

    examples:
      route repeat morning
      route repeat morning --reverse --loops 5 --no-wait
    """
    from omnid.core.navigation.requests import route_name

    words = ["repeat", route_name(args.name), *(["reverse"] if args.reverse else [])]
    text = " ".join([*words, f"loops={args.loops}", f"from={vars(args)['from']}"])
    return _drive(args, lambda driver: driver.route(text))


@command(ROBOT, SETTINGS)
def finish(args: argparse.Namespace) -> int:
    """End the recording and write the route and the map.

    examples:
      route finish
    """
    return ask(args, lambda driver: driver.route("finish"))


@command(ROBOT, SETTINGS)
def end_route(args: argparse.Namespace) -> int:
    """End the repetition, or the recording without a file.

    examples:
      route stop
    """
    return ask(args, lambda driver: driver.route("stop"))


@command(SETTINGS, JSON)
def list_routes(args: argparse.Namespace) -> int:
    """List the routes in navigation.routes, here; exit code 2: a file is damaged.

    examples:
      route list
      route list --json
    """
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


@command(NAME, SETTINGS, JSON)
def show_route(args: argparse.Namespace) -> int:
    """Print length, map and points of a route.

    --tum FILE  write its poses in the TUM format

    examples:
      route show morning --tum morning.txt
    """
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
    (x, y, _), (end_x, end_y, _) = route.poses[0], route.poses[-1]
    summary |= {"length_m": round(route.length_m, 2), "taught": _time(route)}
    summary["from, to"] = f"{x:.2f} {y:.2f}, {end_x:.2f} {end_y:.2f} m in the map"
    print_entries(summary | {"created_s": ""})
    return 0


@command(NAME, SETTINGS)
def delete_route(args: argparse.Namespace) -> int:
    """Delete a route.

    examples:
      route delete morning
    """
    _folder(args).delete(args.name)
    print(f"deleted: {args.name}")
    return 0


def ask(args: argparse.Namespace, *requests: Callable[[Driver], Answer]) -> int:
    """Send requests to the robot, one after the other, and print the last answer. Raise OmnidError with a refusal."""
    from omnid.monitor.navigation import connected, granted

    with connected(settings_of(args).bus) as robot:
        driver = robot.driver()
        answers = [granted(robot, request(driver)) for request in requests]
    print(answers[-1])
    return 0


def _drive(args: argparse.Namespace, request: Callable[[Driver], Answer]) -> int:
    """Ask for a drive and show it until its end, or with --no-wait until the robot has accepted it."""
    from omnid.monitor.navigation import connected, drive_to_end, granted

    with connected(settings_of(args).bus) as robot:
        driver = robot.driver()
        if not args.no_wait:
            return drive_to_end(robot, driver, lambda: request(driver))
        granted(robot, request(driver))
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
