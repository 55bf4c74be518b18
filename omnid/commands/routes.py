"""The routes of a robot on its computer: `omnid route list`, `show`, `delete`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from calib.se2_arrays import transform
from omnid.commands.options import JSON, SETTINGS, command, print_entries, print_json, settings_of
from omnid.commands.robot import NAME
from omnid.core.navigation.route import Route
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.sinks.files import check_outputs, write_trajectory
from omnid.utc import utc


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
            print(f"{route.name:<20} {route.length_m:8.1f} m  {utc(route.created_s * 10**9)}  {route.map_name}")
    return code


@command(NAME, SETTINGS, JSON)
def show_route(args: argparse.Namespace) -> int:
    """Print length, map and points of a route.

    --tum FILE  write its poses in the TUM format

    examples:
      route show morning --tum morning.txt
    """
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
    summary |= {"length_m": round(route.length_m, 2), "taught": utc(route.created_s * 10**9)}
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


def _folder(args: argparse.Namespace) -> RouteFolder:
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
