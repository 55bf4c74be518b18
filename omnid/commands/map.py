"""`omnid map`: build maps of places from logs, show them, export them, and let a robot save its own.

Also the routes on this computer: `omnid route list`, `show`, `delete`.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from calib.se2_arrays import transform
from omnid.commands import options
from omnid.commands.robot import NAME, ask
from omnid.config import unused_settings
from omnid.core.navigation.route import Route
from omnid.core.places import place_views
from omnid.core.places.place_map import PlaceMap, PlaceRig
from omnid.diagnostics.run_summary import Progress
from omnid.errors import OmnidError
from omnid.formats.exports import write_grid, write_ply
from omnid.formats.place_file import read_places, write_places
from omnid.formats.plan import drawn_heights
from omnid.formats.route_file import RouteFolder
from omnid.runs.replay import ReplayOptions, run_log
from omnid.sinks.files import check_outputs, write_plan, write_trajectory
from omnid.stages.obstacles import ADVICE
from omnid.utc import utc

# Suffixes of `map show -o`, and the options of `map export` that write the same.
KINDS: Final = {".ply": "--ply", ".png": "--plan", ".yaml": "--grid", ".yml": "--grid"}
MAP: Final = """
map FILE.omap            a map of places
--cell M=0.05 0.005..10  edge of a cell of the grid, m
"""


@options.command(options.RIG, options.QUIET, options.SETTINGS)
def build(args: argparse.Namespace) -> int:
    """Build a map from logs, of one drive or of several in the same place, each in the map of those before.

    logs LOG...             as of `omnid replay`, the longest first
    -o, --output OUT.omap   the map (required)

    one of:
    --extend   extend the map OUT.omap
    --replace  replace it, with all places that routes refer to

    examples:
      map build monday.mcap tuesday.mcap -o place.omap --rig rig.toml
      map build wednesday.mcap -o place.omap --extend
    """
    # 1. Check the options.
    config = options.settings_of(args)
    if not config.places.enabled or config.places.map:
        raise OmnidError("map build: places.enabled must be true, and places.map empty: change the configuration")
    check_outputs([("-o", args.output)], [("the log that is read", log) for log in args.logs])
    if args.output.exists() and not (args.extend or args.replace):
        raise OmnidError(f"map build: {args.output} exists: --extend adds these logs to it, --replace makes a new one")
    for warning in unused_settings(config, "replay", args.set):
        options.warn(warning)
    # 2. Replay the logs into a copy of the map.
    with TemporaryDirectory() as folder:
        new = Path(folder, args.output.name)
        if args.extend:
            write_places(new, *read_places(args.output))
        config = replace(config, places=replace(config.places, map=str(new)))
        replayed = ReplayOptions(rig=args.rig, settings=args.config, progress=None if args.quiet else Progress())
        for log in args.logs:
            try:
                result = run_log(log, config, replayed)
            except OmnidError as error:
                raise OmnidError(str(error).replace(str(new), str(args.output))) from error
            for warning in result.warnings:
                options.warn(f"{log}: {warning.replace(str(new), str(args.output))}")
            if result.signal:
                options.failed(f"interrupted: {args.output} was not written")
                return 128 + result.signal
        if not new.exists():
            return 1
        places, rig = read_places(new)
    # 3. It is whole now.
    write_places(args.output, places, rig)
    options.print_entries(_described(args.output, places, rig))
    return 0


@options.command(MAP, options.JSON)
def show(args: argparse.Namespace) -> int:
    """Print keyframes, sessions, loops, size, and the rig that made the map; write plan and grid.

    -o, --output OUT.png|.yaml|.ply...  also write the map, as its suffix says: a plan with paths and loops, a grid for
        nav2, landmarks; may be repeated

    examples:
      map show place.omap
      map show place.omap -o place.png -o place.yaml
    """
    for path in args.output:
        if path.suffix not in KINDS:
            raise OmnidError(f"-o {path}: expected a name that ends in .png, .yaml or .ply")
    places, rig, written = _exported(args, [("-o", KINDS[path.suffix], path) for path in args.output])
    if args.json:
        sizes = asdict(place_views.summary(places, rig))
        size_bytes = args.map.stat().st_size
        options.print_json({"path": args.map, "size_bytes": size_bytes, "rig_hash": rig.rig_hash, **sizes})
    else:
        options.print_entries(_described(args.map, places, rig) | {"written": written})
    return 0


@options.command(MAP)
def export(args: argparse.Namespace) -> int:
    """Write a map for other programs.

    --ply FILE.ply    landmarks with confidence and age
    --plan FILE.png   landmarks from above, with the paths and loops
    --grid FILE.yaml  occupancy grid for nav2 and map_server; the image beside it is FILE.pgm

    examples:
      map export place.omap --grid place.yaml --ply place.ply --plan place.png
    """
    named = {"--ply": args.ply, "--plan": args.plan, "--grid": args.grid}
    outputs = [(option, option, path) for option, path in named.items() if path is not None]
    if not outputs:
        raise OmnidError("map export: nothing to write: give --ply FILE.ply, --plan FILE.png or --grid FILE.yaml")
    options.print_entries({"written": _exported(args, outputs)[2]})
    return 0


@options.command(options.ROBOT, options.SETTINGS)
def save(args: argparse.Namespace) -> int:
    """Ask a robot to save its map now, before it is switched off, and print what became of it.

    examples:
      map save
      map save --robot rover --connect tcp/robot:7447
    """
    return ask(args, lambda driver: driver.save_map())


def _exported(args: argparse.Namespace, outputs: list[tuple[str, str, Path]]) -> tuple[PlaceMap, PlaceRig, str]:
    """Write a map to files; return it and the names of all files that were written.

    outputs: for each file the option that names it, its kind (that of an option of `map export`), and its path.
    """
    inputs = [("the map that is read", args.map)]
    named = [(option, path) for option, _, path in outputs]
    check_outputs(named, inputs)  # before the image of a grid is named: a folder, as ".", can have no other end
    named += [("the grid's image", path.with_suffix(".pgm")) for _, kind, path in outputs if kind == "--grid"]
    check_outputs(named, inputs)
    places, rig = read_places(args.map)
    for _, kind, path in outputs:
        if kind == "--grid":
            if not any(keyframe.free_m.any() for keyframe in places.keyframes.values()):
                options.warn(
                    f"{path}: no cell is free: the map was built without the height of the cameras above the floor: "
                    f"{ADVICE}, and build the map again"
                )
            write_grid(path, place_views.grid(places, rig, args.cell))
        elif kind == "--ply":
            write_ply(path, place_views.landmarks(places, rig))
        else:
            # A map has the axes of the base, whose origin is on the floor where the rig states the cameras' height.
            height_m = float(rig.T_base_rect[2, 3])
            low_m, high_m = (height_m + at_m for at_m in drawn_heights(height_m))
            paths, loops = place_views.paths_xy(places, rig), place_views.loops_xy(places, rig)
            write_plan(path, place_views.landmarks(places, rig), paths, (low_m, high_m), loops)
    return places, rig, ", ".join(str(path) for _, path in named)


def _described(path: Path, places: PlaceMap, rig: PlaceRig) -> dict[str, str]:
    """Return the properties of a map, as they are printed."""
    sizes, size = place_views.summary(places, rig), path.stat().st_size
    return {
        "map": str(path),
        "size": f"{size / 1e6:.1f} MB, {size / max(1, sizes.keyframes) / 1e3:.0f} kB a keyframe",
        "time": f"{utc(sizes.first_stamp_ns)} to {utc(sizes.last_stamp_ns)}",
        "sessions": str(sizes.sessions),
        "keyframes": f"{sizes.keyframes}, with {sizes.features} features; {sizes.dropped} were dropped",
        "loops": str(sizes.loops),
        "path": f"{sizes.path_m:.1f} m, within {sizes.extent_m[0]:.1f} x {sizes.extent_m[1]:.1f} m",
        "parts": f"{sizes.parts}, between which no pose is known" if sizes.parts > 1 else "",
        "rig": f"{rig.rig_hash[:12]}, baseline {rig.baseline_m:.4f} m, panoramas of {rig.cylinder.width} x "
        f"{rig.cylinder.height} px",
    }


@options.command(options.SETTINGS, options.JSON)
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
            options.failed(str(error))
            code = 2
    if args.json:
        options.print_json([_summary(route) for route in found])
    elif not found and not code:
        print(f"no routes in {folder.folder}: teach one (`omnid route teach NAME`)")
    else:
        for route in found:
            print(f"{route.name:<20} {route.length_m:8.1f} m  {utc(route.created_s * 10**9)}  {route.map_name}")
    return code


@options.command(NAME, options.SETTINGS, options.JSON)
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
        options.print_json({**summary, "points": [[*pose, speed] for pose, speed in rows]})
        return 0
    (x, y, _), (end_x, end_y, _) = route.poses[0], route.poses[-1]
    summary |= {"length_m": round(route.length_m, 2), "taught": utc(route.created_s * 10**9)}
    summary["from, to"] = f"{x:.2f} {y:.2f}, {end_x:.2f} {end_y:.2f} m in the map"
    options.print_entries(summary | {"created_s": ""})
    return 0


@options.command(NAME, options.SETTINGS)
def delete_route(args: argparse.Namespace) -> int:
    """Delete a route.

    examples:
      route delete morning
    """
    _folder(args).delete(args.name)
    print(f"deleted: {args.name}")
    return 0


def _folder(args: argparse.Namespace) -> RouteFolder:
    return RouteFolder(Path(options.settings_of(args).navigation.routes))


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
