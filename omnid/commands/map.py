"""`omnid map`: build, show, merge and export maps of places."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.config import add_settings
from omnid.commands.json_output import add_json, print_json
from omnid.commands.listen import add_robot, config_of
from omnid.commands.map_option import add_tags_option, tag_settings
from omnid.commands.map_tags import add_align, add_tags
from omnid.utc import utc

if TYPE_CHECKING:
    from omnid.core.places.place_rig import PlaceRig
    from omnid.core.places.place_views import PlaceSummary

CELL_M = 0.05


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `map` to the command line."""
    parser = subparsers.add_parser("map", help="build, show, merge and export maps of places (.omap)")
    actions = parser.add_subparsers(required=True, metavar="action", parser_class=type(parser))
    _add_build(actions)
    info = actions.add_parser("info", help="keyframes, sessions, loops, size, and the rig that made the map")
    info.add_argument("maps", type=Path, nargs="+", metavar="FILE.omap")
    add_json(info)
    info.set_defaults(run=run_info)
    show = actions.add_parser("show", help="a page with keyframes, loops, and the paths with and without the loops")
    show.add_argument("map", type=Path, metavar="FILE.omap")
    show.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.html")
    show.set_defaults(run=run_show)
    merge = actions.add_parser("merge", help="join maps of one building, made by the same rig")
    merge.add_argument(
        "maps", type=Path, nargs="+", metavar="FILE.omap", help="two or more; the frame of the first stays"
    )
    merge.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.omap")
    merge.set_defaults(run=run_merge)
    add_tags(actions)
    add_align(actions)
    _add_export(actions)
    save = actions.add_parser("save", help="ask a robot to save its map now, before it is switched off")
    add_robot(save)
    add_settings(save)
    save.set_defaults(run=run_save)


def _add_build(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    build = actions.add_parser("build", help="build a map from logs, of one drive or of several in the same place")
    build.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="as of `omnid replay`, the longest first")
    build.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.omap")
    build.add_argument("--extend", action="store_true", help="extend the map OUT.omap")
    add_tags_option(build)
    build.add_argument("--rig", type=Path, help="the rig.toml of the cameras; default: that attached to the log")
    build.add_argument("--quiet", action="store_true", help="do not show the progress")
    add_settings(build)
    build.set_defaults(run=run_build)


def _add_export(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    export = actions.add_parser("export", help="write a map for other programs")
    export.add_argument("map", type=Path, metavar="FILE.omap")
    export.add_argument("--ply", type=Path, metavar="FILE.ply", help="landmarks with confidence and age")
    export.add_argument("--plan", type=Path, metavar="FILE.png", help="landmarks from above, with the paths")
    export.add_argument(
        "--grid",
        type=Path,
        metavar="FILE.yaml",
        help="occupancy grid for nav2 and map_server; the image beside it is FILE.pgm",
    )
    export.add_argument("--cell", type=float, default=CELL_M, metavar="M", help="edge of a cell; default %(default)s m")
    export.set_defaults(run=run_export)


def run_build(args: argparse.Namespace) -> int:
    """Replay the logs one after the other, each in the map of those before, and write the map."""
    from omnid.config import load_config
    from omnid.config_use import unused_settings
    from omnid.core.places.place_views import summary
    from omnid.diagnostics.progress import Progress
    from omnid.errors import OmnidError
    from omnid.formats.place_file import read_places, write_places
    from omnid.runs.place_maps import RigPlaces, new_places
    from omnid.runs.replay import ReplayOptions, run_log
    from omnid.sinks.files import check_outputs

    config = load_config(args.config, [*args.overrides, *tag_settings(args)])
    warnings = unused_settings(config, "replay", args.overrides)
    if not config.places.enabled or config.places.map:
        raise OmnidError("map build: places.enabled must be true, and places.map empty: change the configuration")
    check_outputs([("-o", args.output)], [("the log that is read", log) for log in args.logs])
    built = RigPlaces(*read_places(args.output, new_places(config.places))) if args.extend else None
    for log in args.logs:
        options = ReplayOptions(
            rig=args.rig, settings=args.config, build=True, rig_places=built, progress=None if args.quiet else Progress
        )
        result = run_log(log, config, options)
        for warning in (*warnings, *result.warnings):
            print(f"omnid: warning: {log}: {warning}", file=sys.stderr)
        warnings = []
        if result.signal:
            print(f"omnid: interrupted: {args.output} was not written", file=sys.stderr)
            return 128 + result.signal
        built = result.rig_places
    if built is None or not built.places.keyframes:
        print("omnid: no keyframe was found: no map was written", file=sys.stderr)
        return 1
    write_places(args.output, built.places, built.rig)
    print(*_described(args.output, summary(built.places, built.rig), built.rig), sep="\n")
    return 0


def run_info(args: argparse.Namespace) -> int:
    """Print the content of each map; return 2 if a file is not a map."""
    from omnid.core.places.place_views import summary
    from omnid.errors import OmnidError
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
        found.append({"path": path, "size_bytes": path.stat().st_size, "rig_hash": rig.rig_hash, **_plain(sizes)})
        if not args.json:
            print(*[""] * bool(number), *_described(path, sizes, rig), sep="\n")
    if args.json:
        print_json(found)
    return code


def run_show(args: argparse.Namespace) -> int:
    """Write the page."""
    from calib.rig_file import write_file
    from omnid.core.places.place_views import summary
    from omnid.formats.place_file import read_places
    from omnid.report.map_page import map_page
    from omnid.sinks.files import check_outputs

    check_outputs([("-o", args.output)], [("the map that is read", args.map)])
    places, rig = read_places(args.map)
    lines = [(line[:13].strip(), line[13:]) for line in _described(args.map, summary(places, rig), rig)]
    html = map_page(args.map.name, lines, places, rig)
    write_file(args.output, html.encode("utf-8", "replace"))  # a file's name may be no text
    print(f"written      {args.output}")
    return 0


def run_save(args: argparse.Namespace) -> int:
    """Ask the robot to save its map, and print what became of it."""
    from omnid.monitor.navigation import connected, granted

    with connected(config_of(args).bus) as robot:
        print(granted(robot, robot.driver().save_map()))
    return 0


def run_merge(args: argparse.Namespace) -> int:
    """Join the maps, each to those before."""
    from omnid.core.places.merge import merge
    from omnid.core.places.place_rig import seen_by
    from omnid.core.places.place_views import summary
    from omnid.core.types.stereo_model import StereoModel
    from omnid.errors import OmnidError
    from omnid.formats.place_file import read_places, write_places
    from omnid.sinks.files import check_outputs

    if len(args.maps) < 2:
        raise OmnidError("map merge: expected two maps or more")
    check_outputs([("-o", args.output)], [])
    places, rig = read_places(args.maps[0])
    for path in args.maps[1:]:
        other, other_rig = read_places(path)
        if difference := other_rig.difference(rig):
            raise OmnidError(f"{path}: this map was made with {difference}: build one with the rig of {args.maps[0]}")
        seen_by(other, other_rig, rig)
        if not merge(places, other, StereoModel(rig.cylinder, rig.baseline_m)):
            raise OmnidError(
                f"{path}: it shares no place with the maps before that is recognised: drive where both "
                "have been, and add that log by `omnid map build LOG --extend`"
            )
    write_places(args.output, places, rig)
    print(*_described(args.output, summary(places, rig), rig), sep="\n")
    return 0


def run_export(args: argparse.Namespace) -> int:
    """Write the files that are asked for."""
    import numpy as np

    from omnid.core.places import place_views
    from omnid.errors import OmnidError
    from omnid.formats.grid_map import write_grid
    from omnid.formats.place_file import read_places
    from omnid.formats.ply import write_ply
    from omnid.sinks.files import check_outputs, write_plan
    from omnid.stages.floor import ADVICE

    named = (("--ply", args.ply), ("--plan", args.plan), ("--grid", args.grid))
    outputs = [(option, path) for option, path in named if path is not None]
    if not outputs:
        raise OmnidError("map export: nothing to write: give --ply FILE.ply, --plan FILE.png or --grid FILE.yaml")
    if not 0.005 <= args.cell <= 10:
        raise OmnidError(f"--cell {args.cell:g}: expected an edge of 0.005 to 10 m")
    images = [("--grid's image", args.grid.with_suffix(".pgm"))] if args.grid else []
    check_outputs([*outputs, *images], [("the map that is read", args.map)])
    places, rig = read_places(args.map)
    if args.grid:
        if not any(np.isfinite(keyframe.scan).any() for keyframe in places.keyframes.values()):
            print(
                f"omnid: warning: {args.grid}: all cells are unknown: the map is of an earlier version, or was built "
                f"without the height of the cameras above the floor: {ADVICE}, and build the map again",
                file=sys.stderr,
            )
        write_grid(args.grid, place_views.grid(places, rig, args.cell))
    if args.ply or args.plan:
        points = place_views.landmarks(places, rig)
        if args.ply:
            write_ply(args.ply, points)
        if args.plan:
            write_plan(args.plan, points, place_views.base_poses(places, rig)[:, :2, 3])
    print("written     ", ", ".join(str(path) for _, path in [*outputs, *images]))
    return 0


def _plain(sizes: PlaceSummary) -> dict[str, object]:
    from dataclasses import asdict

    return asdict(sizes)


def _described(path: Path, sizes: PlaceSummary, rig: PlaceRig) -> Iterator[str]:
    per_keyframe = path.stat().st_size / max(1, sizes.keyframes)
    yield f"map          {path}"
    yield f"size         {path.stat().st_size / 1e6:.1f} MB, {per_keyframe / 1e3:.0f} kB a keyframe"
    yield f"time         {utc(sizes.first_stamp_ns)} to {utc(sizes.last_stamp_ns)}"
    yield f"sessions     {sizes.sessions}"
    yield f"keyframes    {sizes.keyframes}, with {sizes.features} features; {sizes.dropped} were dropped"
    yield f"loops        {sizes.loops}"
    if sizes.tags:
        yield f"tags         {sizes.tags}, of which {sizes.tags_seen} were seen; `omnid map tags` lists them"
    yield f"path         {sizes.path_m:.1f} m, within {sizes.extent_m[0]:.1f} x {sizes.extent_m[1]:.1f} m"
    if sizes.parts > 1:
        yield f"parts        {sizes.parts}, between which no pose is known"
    yield (
        f"rig          {rig.rig_hash[:12]}, baseline {rig.baseline_m:.4f} m, panoramas of "
        f"{rig.cylinder.width} x {rig.cylinder.height} px"
    )
