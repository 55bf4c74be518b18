"""`omnid route`: teach routes by driving, repeat, list, show and delete them."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.config import add_settings, settings_of
from omnid.commands.json_output import add_json, print_json
from omnid.commands.listen import add_robot, config_of
from omnid.errors import OmnidError

if TYPE_CHECKING:
    from omnid.core.navigation.route import Route
    from omnid.formats.route_file import RouteFolder


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `route` to the command line."""
    parser = subparsers.add_parser(
        "route",
        help="teach a route by driving it, and repeat it",
        description="Routes are tied to the saved map that the robot runs with (`omnid run "
        "--map FILE.omap`). They lie on the robot, in navigation.routes.",
    )
    actions = parser.add_subparsers(required=True, metavar="action", parser_class=type(parser))
    teach = _add(
        actions, "teach", run_teach, "record a route while somebody drives (`omnid drive`, a joystick)", on_robot=False
    )
    teach.add_argument(
        "--replace",
        action="store_true",
        help="in the place of a route of that name, which stays until "
        "the new one is written; without it an existing name is refused",
    )
    teach.add_argument("--no-wait", action="store_true", help="end at once: `omnid route finish` writes it")
    _add(actions, "finish", run_text, "end the recording and write the route and the map", on_robot=False, named=False)
    repeat = _add(actions, "repeat", run_repeat, "drive a route, from where the robot is on it", on_robot=False)
    repeat.add_argument("--reverse", action="store_true", help="from its end to its start")
    repeat.add_argument(
        "--loops",
        type=int,
        default=1,
        metavar="N",
        help="a closed route is driven in rounds, another there and back, N times in all; default %(default)s",
    )
    repeat.add_argument(
        "--from",
        choices=("here", "start"),
        default="here",
        dest="begin",
        help="here: from where the robot is on the route, anywhere within 1.5 m of it; start: the whole route, refused "
        "elsewhere; default %(default)s",
    )
    repeat.add_argument("--no-wait", action="store_true", help="end as soon as the robot has accepted it")
    _add(actions, "stop", run_text, "end the repetition, or the recording without a file", on_robot=False, named=False)
    add_json(_add(actions, "list", run_list, "the routes in navigation.routes, here", named=False))
    show = _add(actions, "show", run_show, "length, map and points of a route")
    add_json(show)
    show.add_argument("--tum", type=Path, metavar="FILE", help="write its poses in the TUM format")
    _add(actions, "delete", run_delete, "delete a route")


def _add(
    actions: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: object,
    help: str,
    *,
    on_robot: bool = True,
    named: bool = True,
) -> argparse.ArgumentParser:
    """Add an action.

    on_robot: the command runs on the robot's computer and works on its files, so it has no option for a connection.
    named: it takes the name of a route.
    """
    parser = actions.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
    if named:
        parser.add_argument("name", metavar="NAME", help="letters, digits, '-' and '_'")
    if not on_robot:
        add_robot(parser)
    add_settings(parser)
    parser.set_defaults(run=run, action=name)
    return parser


def run_teach(args: argparse.Namespace) -> int:
    """Record until Enter is pressed; Ctrl-C drops the recording."""
    from omnid.core.navigation.requests import route_name
    from omnid.monitor.navigation import connected, granted, record_until_enter

    name = route_name(args.name)
    with connected(config_of(args).bus) as robot:
        granted(robot, robot.driver().route(f"teach {name} replace" if args.replace else f"teach {name}"))
        if args.no_wait:
            print(f"records {name}: drive it, then `omnid route finish`")
            return 0
        return record_until_enter(robot, name)


def run_repeat(args: argparse.Namespace) -> int:
    """Repeat a route; return 0 if its end is reached, else 1."""
    from omnid.core.navigation.requests import MAX_LOOPS, route_name
    from omnid.monitor.navigation import connected, drive_to_end, granted

    if not 1 <= args.loops <= MAX_LOOPS:
        raise OmnidError(f"--loops {args.loops}: expected 1 to {MAX_LOOPS}")
    words = ["repeat", route_name(args.name), *(["reverse"] if args.reverse else [])]
    text = " ".join([*words, f"loops={args.loops}", f"from={args.begin}"])
    with connected(config_of(args).bus) as robot:
        driver = robot.driver()
        ask = partial(driver.route, text)
        if not args.no_wait:
            return drive_to_end(robot, driver, ask)
        granted(robot, ask())
        return 0


def run_text(args: argparse.Namespace) -> int:
    """Send `finish` or `stop` and print the robot's answer."""
    from omnid.monitor.navigation import connected, granted

    with connected(config_of(args).bus) as robot:
        print(granted(robot, robot.driver().route(args.action)))
    return 0


def run_list(args: argparse.Namespace) -> int:
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


def run_show(args: argparse.Namespace) -> int:
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
    if args.json:
        print_json(
            {
                **_summary(route),
                "points": [
                    [*pose, speed] for pose, speed in zip(route.poses.tolist(), route.speeds.tolist(), strict=True)
                ],
            }
        )
        return 0
    summary = _summary(route)
    for key in ("name", "map", "length_m", "points", "keyframes", "closed"):
        print(f"{key:<12} {summary[key] if key != 'length_m' else round(route.length_m, 2)}")
    print(f"{'taught':<12} {_time(route)}")
    (x, y, _), (end_x, end_y, _) = route.poses[0], route.poses[-1]
    print(f"{'from, to':<12} {x:.2f} {y:.2f}, {end_x:.2f} {end_y:.2f} m in the map")
    return 0


def run_delete(args: argparse.Namespace) -> int:
    """Delete a route."""
    _folder(args).delete(args.name)
    print(f"deleted: {args.name}")
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
