"""`omnid map build`: a map from logs, each in the map of those before, or side by side and then joined."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.map_summary import described
from omnid.commands.options import (
    PROFILES,
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
from omnid.commands.worker_options import end_by_sigterm, program_options, workers
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
    *workers("logs at a time, whose maps are then joined; 1: each in the map of those before", 1),
    QUIET,
    *SETTINGS,
    examples=(
        "map build monday.mcap tuesday.mcap -o place.omap --rig rig.toml",
        "map build wednesday.mcap -o place.omap --extend",
        "map build logs/*.mcap -o site.omap --jobs 4",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Replay the logs one after the other, each in the map of those before, or side by side; write the map."""
    from omnid.config_use import unused_settings
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
    side_by_side = args.dask is not None or args.jobs != 1
    built = _side_by_side(args, config) if side_by_side else _one_after_the_other(args, config)
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


def _side_by_side(args: argparse.Namespace, config: Config) -> RigPlaces | None:
    """Return the joined maps of the logs; None: they have no keyframe."""
    from omnid.batch.map_builder import build_map
    from omnid.batch.workers import workers_of
    from omnid.formats.place_file import read_places
    from omnid.runs.place_maps import RigPlaces, new_places

    def report(line: str) -> None:
        if not args.quiet or line.startswith("omnid: "):
            print(line, file=sys.stderr)

    paths = {"--rig": args.rig, "--config": args.config, "--tags": args.tags}
    options = program_options(paths, {}, [*PROFILES.get(args.profile, ()), *args.overrides])
    end_by_sigterm()
    # Beside the output: workers on other machines reach it there.
    output = args.output.absolute()
    folder = Path(tempfile.mkdtemp(prefix=f".{output.name}-", dir=output.parent))
    try:
        with workers_of(args.jobs, args.dask) as workers:
            found = build_map(args.logs, options, output if args.extend else None, folder, workers, report)
        return None if found is None else RigPlaces(*read_places(found, new_places(config.places)))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
