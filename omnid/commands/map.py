"""Maps of places: `omnid map build`, `show`, `export`."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from calib.rig_file import png
from omnid.commands import options
from omnid.core.places import place_views
from omnid.core.places.place_map import PlaceMap, PlaceRig
from omnid.diagnostics.status import show_progress
from omnid.errors import OmnidError
from omnid.formats.exports import write_grid, write_ply, write_whole
from omnid.formats.place_file import read_places, write_places
from omnid.formats.plan import drawn_heights, plan_view
from omnid.runs.replay import ReplayOptions, run_log
from omnid.sinks.files import check_outputs
from omnid.stages.obstacles import FLOOR_WARNING

MAP: Final = "map FILE.omap  a map of places"


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
    config = options.settings_of(args, run="replay")
    if not config.places.enabled or config.places.map:
        raise OmnidError("map build: places.enabled must be true, and places.map empty: change the configuration")
    check_outputs([("-o", args.output)], [("the log that is read", log) for log in args.logs])
    if args.output.exists() and not (args.extend or args.replace):
        raise OmnidError(f"map build: {args.output} exists: --extend adds these logs to it, --replace makes a new one")
    # 2. Replay the logs into a copy of the map.
    with TemporaryDirectory() as folder:
        new = Path(folder, args.output.name)
        if args.extend:
            write_places(new, *read_places(args.output))
        config = replace(config, places=replace(config.places, map=str(new)))
        replayed = ReplayOptions(rig=args.rig, settings=args.config, progress=None if args.quiet else show_progress)
        for log in args.logs:
            result = run_log(log, config, replayed)
            for warning in result.warnings:
                options.warn(f"{log}: {warning}")
            if result.signal:
                options.failed(f"interrupted: {args.output} was not written")
                return 128 + result.signal
        if not new.exists():
            return 1
        places, rig = read_places(new)
    # 3. Replace the map, which holds all logs now.
    write_places(args.output, places, rig)
    options.print_entries(_described(args.output, places, rig))
    return 0


@options.command(MAP)
def show(args: argparse.Namespace) -> int:
    """Print keyframes, sessions, loops, size, and the rig that made the map.

    examples:
      map show place.omap
    """
    options.print_entries(_described(args.map, *read_places(args.map)))
    return 0


@options.command(MAP)
def export(args: argparse.Namespace) -> int:
    """Write a map for other programs.

    --ply FILE.ply           landmarks with confidence and age
    --plan FILE.png          landmarks from above, with the paths and loops
    --grid FILE.yaml         occupancy grid for nav2 and map_server; the image beside it is FILE.pgm
    --cell M=0.05 0.005..10  edge of a cell of the grid, and of the voxels of landmarks, m

    examples:
      map export place.omap --grid place.yaml --ply place.ply --plan place.png
    """
    named = [(f"--{kind}", path) for kind in ("ply", "plan", "grid") if (path := vars(args)[kind]) is not None]
    if not named:
        raise OmnidError("map export: nothing to write: give --ply FILE.ply, --plan FILE.png or --grid FILE.yaml")
    if args.grid is not None:
        named.append(("the grid's image", args.grid.parent / f"{args.grid.stem}.pgm"))
    check_outputs(named, [("the map that is read", args.map)])
    places, rig = read_places(args.map)
    if args.grid is not None:
        if not any(keyframe.free_m.any() for keyframe in places.keyframes.values()):
            options.warn(f"{args.grid}: no cell is free, as the floor was not known: {FLOOR_WARNING}")
        write_grid(args.grid, place_views.grid(places, rig, args.cell))
    if args.ply is not None:
        write_ply(args.ply, place_views.landmarks(places, rig, args.cell))
    if args.plan is not None:
        # A map has the axes of the base, whose origin is on the floor where the rig states the cameras' height.
        height_m = float(rig.T_base_rect[2, 3])
        low_m, high_m = (height_m + at_m for at_m in drawn_heights(height_m))
        paths, loops = place_views.paths_xy(places, rig), place_views.loops_xy(places, rig)
        points = place_views.landmarks(places, rig, args.cell)
        write_whole(args.plan, png(plan_view(points, paths, heights_m=(low_m, high_m), loops_xy=loops)))
    options.print_entries({"written": ", ".join(str(path) for _, path in named)})
    return 0


def _described(path: Path, places: PlaceMap, rig: PlaceRig) -> dict[str, str]:
    """Return the properties of a map, as they are printed."""
    size = path.stat().st_size
    path_m = sum(math.hypot(*link.T_a_b[:3, 3]) for link in places.links if not link.is_loop)
    return {
        "map": str(path),
        "size": f"{size / 1e6:.1f} MB, {size / max(1, len(places)) / 1e3:.0f} kB a keyframe",
        "sessions": str(len({keyframe.session for keyframe in places.keyframes.values()})),
        "keyframes": f"{len(places)}; {places.dropped} were dropped",
        "loops": str(places.loops),
        "path": f"{path_m:.1f} m",
        "rig": f"{rig.rig_hash[:12]}, baseline {rig.baseline_m:.4f} m, panoramas of {rig.cylinder.width} x "
        f"{rig.cylinder.height} px",
    }
