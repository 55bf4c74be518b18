"""`omnid map build`: a map from logs, each in the map of those before."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.map_summary import described
from omnid.commands.options import (
    QUIET,
    REPLACE,
    RIG,
    SETTINGS,
    TAGS,
    command,
    exclusive,
    option,
    settings_of,
)
from omnid.errors import OmnidError

if TYPE_CHECKING:
    from omnid.config import Config
    from omnid.runs.place_maps import RigPlaces


@command(
    option("logs", type=Path, nargs="+", metavar="LOG", help="as of `omnid replay`, the longest first"),
    option("-o", "--output", type=Path, required=True, metavar="OUT.omap"),
    exclusive(option("--extend", action="store_true", help="extend the map OUT.omap"), REPLACE),
    TAGS,
    RIG,
    QUIET,
    *SETTINGS,
    examples=(
        "map build monday.mcap tuesday.mcap -o place.omap --rig rig.toml",
        "map build wednesday.mcap -o place.omap --extend",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Replay the logs one after the other, each in the map of those before; write the map."""
    from omnid.config import unused_settings
    from omnid.core.places.place_views import summary
    from omnid.formats.place_file import write_places
    from omnid.sinks.files import check_outputs

    config = settings_of(args)
    warnings = unused_settings(config, "replay", args.overrides)
    if not config.places.enabled or config.places.map:
        raise OmnidError("map build: places.enabled must be true, and places.map empty: change the configuration")
    check_outputs([("-o", args.output)], [("the log that is read", log) for log in args.logs])
    if args.output.exists() and not (args.extend or args.replace):
        raise OmnidError(f"map build: {args.output} exists: --extend adds these logs to it, --replace makes a new one")
    for warning in warnings:
        print(f"omnid: warning: {warning}", file=sys.stderr)
    built = _one_after_the_other(args, config)
    if isinstance(built, int):
        print(f"omnid: interrupted: {args.output} was not written", file=sys.stderr)
        return 128 + built
    if built is None or not built.places.keyframes:
        print("omnid: no keyframe was found: no map was written", file=sys.stderr)
        return 1
    write_places(args.output, built.places, built.rig)
    print(*described(args.output, summary(built.places, built.rig), built.rig), sep="\n")
    return 0


def _one_after_the_other(args: argparse.Namespace, config: Config) -> RigPlaces | int | None:
    """Return the map of the logs; None: they have no keyframe. A number is that of the signal that ended it."""
    from omnid.diagnostics.progress import Progress
    from omnid.formats.place_file import read_places
    from omnid.runs.place_maps import RigPlaces, new_places
    from omnid.runs.replay import ReplayOptions, run_log

    built = RigPlaces(*read_places(args.output, new_places(config.places))) if args.extend else None
    for log in args.logs:
        options = ReplayOptions(
            rig=args.rig, settings=args.config, build=True, rig_places=built, progress=None if args.quiet else Progress
        )
        result = run_log(log, config, options)
        for warning in result.warnings:
            print(f"omnid: warning: {log}: {warning}", file=sys.stderr)
        if result.signal:
            return result.signal
        built = result.rig_places
    return built
