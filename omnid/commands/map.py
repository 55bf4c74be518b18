"""`omnid map`: show, merge and export maps of places."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from omnid.commands.json_output import print_json
from omnid.commands.map_option import require_replace
from omnid.commands.map_summary import described
from omnid.commands.options import JSON, REPLACE, ROBOT, SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

CELL_M = 0.05


@command(option("maps", type=Path, nargs="+", metavar="FILE.omap"), JSON, examples=("map info place.omap",))
def info(args: argparse.Namespace) -> int:
    """Print the content of each map; return 2 if a file is not a map."""
    from omnid.core.places.place_views import summary
    from omnid.formats.place_file import read_places

    code, found = 0, []
    for number, path in enumerate(args.maps):
        try:
            places, rig = read_places(path)
        except OmnidError as error:
            print(f"omnid: {error}", file=sys.stderr)
            code = 2
            continue
        sizes = summary(places, rig)
        found.append({"path": path, "size_bytes": path.stat().st_size, "rig_hash": rig.rig_hash, **asdict(sizes)})
        if not args.json:
            print(*[""] * bool(number), *described(path, sizes, rig), sep="\n")
    if args.json:
        print_json(found)
    return code


@command(
    option("map", type=Path, metavar="FILE.omap"),
    option("-o", "--output", type=Path, required=True, metavar="OUT.html"),
    examples=("map show place.omap -o place.html",),
)
def show(args: argparse.Namespace) -> int:
    """Write the page."""
    from calib.rig_file import write_file
    from omnid.core.places.place_views import summary
    from omnid.formats.place_file import read_places
    from omnid.report.map_page import map_page
    from omnid.sinks.files import check_outputs

    check_outputs([("-o", args.output)], [("the map that is read", args.map)])
    places, rig = read_places(args.map)
    lines = [(line[:13].strip(), line[13:]) for line in described(args.map, summary(places, rig), rig)]
    html = map_page(args.map.name, lines, places, rig)
    write_file(args.output, html.encode("utf-8", "replace"))  # a file's name may be no text
    print(f"written      {args.output}")
    return 0


@command(*ROBOT, *SETTINGS, examples=("map save", "map save --robot rover --connect tcp/robot:7447"))
def save(args: argparse.Namespace) -> int:
    """Ask the robot to save its map, and print what became of it."""
    from omnid.monitor.navigation import connected, granted

    with connected(settings_of(args).bus) as robot:
        print(granted(robot, robot.driver().save_map()))
    return 0


@command(
    option("maps", type=Path, nargs="+", metavar="FILE.omap", help="two or more; the frame of the first stays"),
    option("-o", "--output", type=Path, required=True, metavar="OUT.omap"),
    REPLACE,
    examples=("map merge east.omap west.omap -o place.omap",),
)
def merge(args: argparse.Namespace) -> int:
    """Join the maps, each to those before."""
    from omnid.core.places.merge import NO_COMMON_PLACE
    from omnid.core.places.merge import merge as merge_maps
    from omnid.core.places.place_rig import seen_by
    from omnid.core.places.place_views import summary
    from omnid.core.types.stereo_model import StereoModel
    from omnid.engine.kernel_cache import prepare_kernels
    from omnid.formats.place_file import read_places, write_places
    from omnid.sinks.files import check_outputs

    if len(args.maps) < 2:
        raise OmnidError("map merge: expected two maps or more")
    for number, path in enumerate(args.maps):
        if path.exists() and any(other.exists() and path.samefile(other) for other in args.maps[:number]):
            raise OmnidError(f"map merge: expected maps of several drives, found {path} twice: name each once")
    check_outputs([("-o", args.output)], [])
    require_replace("map merge", args, args.maps)
    places, rig = read_places(args.maps[0])
    for path in args.maps[1:]:
        other, other_rig = read_places(path)
        if difference := other_rig.difference(rig):
            raise OmnidError(f"{path}: this map was made with {difference}: build one with the rig of {args.maps[0]}")
        seen_by(other, other_rig, rig)
        prepare_kernels()
        try:
            recognised = merge_maps(places, other, StereoModel(rig.cylinder, rig.baseline_m))
        except ValueError as error:
            raise OmnidError(
                f"map merge: {path}: {error}: measure it, and build the map with the wrong size again by "
                "`omnid map build LOG --tags TAGS.toml`"
            ) from None
        if not recognised:
            raise OmnidError(
                f"{path}: it {NO_COMMON_PLACE} with the maps before that is recognised: drive where both "
                "have been, and add that log by `omnid map build LOG --extend`"
            )
    write_places(args.output, places, rig)
    print(*described(args.output, summary(places, rig), rig), sep="\n")
    return 0


@command(
    option("map", type=Path, metavar="FILE.omap"),
    option("--ply", type=Path, metavar="FILE.ply", help="landmarks with confidence and age"),
    option("--plan", type=Path, metavar="FILE.png", help="landmarks from above, with the paths"),
    option(
        "--grid",
        type=Path,
        metavar="FILE.yaml",
        help="occupancy grid for nav2 and map_server; the image beside it is FILE.pgm",
    ),
    option("--cell", type=float, default=CELL_M, metavar="M", help="edge of a cell; default %(default)s m"),
    examples=("map export place.omap --grid place.yaml --ply place.ply --plan place.png",),
)
def export(args: argparse.Namespace) -> int:
    """Write the files that are asked for."""

    from omnid.core.places import place_views
    from omnid.formats.grid_map import write_grid
    from omnid.formats.place_file import read_places
    from omnid.formats.plan_view import drawn_heights
    from omnid.formats.ply import write_ply
    from omnid.sinks.files import check_outputs, write_plan
    from omnid.stages.floor import ADVICE

    named = (("--ply", args.ply), ("--plan", args.plan), ("--grid", args.grid))
    outputs = [(option, path) for option, path in named if path is not None]
    if not outputs:
        raise OmnidError("map export: nothing to write: give --ply FILE.ply, --plan FILE.png or --grid FILE.yaml")
    if not 0.005 <= args.cell <= 10:
        raise OmnidError(f"--cell {args.cell:g}: expected an edge of 0.005 to 10 m")
    inputs = [("the map that is read", args.map)]
    check_outputs(outputs, inputs)  # before the image of a grid is named: a folder, as ".", can have no other end
    images = [("--grid's image", args.grid.with_suffix(".pgm"))] if args.grid else []
    check_outputs([*outputs, *images], inputs)
    places, rig = read_places(args.map)
    if args.grid:
        if not any(keyframe.free_m.any() for keyframe in places.keyframes.values()):
            print(
                f"omnid: warning: {args.grid}: no cell is free: the map is of an earlier version, or was built "
                f"without the height of the cameras above the floor: {ADVICE}, and build the map again",
                file=sys.stderr,
            )
        write_grid(args.grid, place_views.grid(places, rig, args.cell))
    if args.ply or args.plan:
        points = place_views.landmarks(places, rig)
        if args.ply:
            write_ply(args.ply, points)
        if args.plan:
            # A map has the axes of the base, whose origin is on the floor where the rig states the cameras' height.
            height_m = float(rig.T_base_rect[2, 3])
            low_m, high_m = drawn_heights(height_m)
            paths_xy = place_views.paths_xy(places, rig)
            write_plan(args.plan, points, paths_xy, (low_m + height_m, high_m + height_m))
    print("written     ", ", ".join(str(path) for _, path in [*outputs, *images]))
    return 0
