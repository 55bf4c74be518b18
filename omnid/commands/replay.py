"""`omnid replay`: compute trajectory, map and velocity commands of a recorded log."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from omnid.commands.options import (
    CAMERAS,
    JSON,
    MAP,
    QUIET,
    RATE,
    RIG,
    SETTINGS,
    VERBOSE,
    command,
    print_json,
    settings_of,
    warn,
)
from omnid.config import Config, unused_settings
from omnid.diagnostics.run_summary import Progress, run_summary, summary_entries
from omnid.errors import OmnidError
from omnid.runs.replay import ReplayOptions, run_log


@command(VERBOSE, QUIET, RIG, CAMERAS, RATE, MAP, SETTINGS, JSON)
def run(args: argparse.Namespace) -> int:
    """Run a recorded log through the stages of the daemon, and print a summary.

    Exit code 1: no pose was found, or a tenth of the pairs is missing.

    log LOG              an .mcap, .db3 or .bag file, a folder with one or with its parts, or a folder with a folder of
        stamped images for each camera
    --start-s S=0 0..    leave out the first S seconds
    --seconds S 0.001..  read so many seconds only; default: to the end

    outputs:
    --tum FILE            trajectory, T_odom_rig, one row for every pair
    --map-tum FILE        trajectory in the map, T_map_rig: places that are recognised correct all poses before them
    --cloud FILE.ply      the map's points with confidence and age
    --plan FILE.png       the map from above with the path
    --record FILE.mcap    poses, transforms, commands, states and map
    --rerun FILE.rrd      path, images with features, depth and plots for the viewer Rerun; not beside --record
    --publish             publish on the bus as `<robot>/odom` and so on; off by default, because a robot's daemon
        publishes there
    --motor PORT [motor.port]  send commands to the motor controller on a serial port (the wheels will turn!), or to a
        'simulated' one

    computation:
    --method default|paper [odometry.method]   paper: the odometry of the paper on its enhanced SAD, for comparison
    --tracker improved|klt [odometry.tracker]  feature tracker of the paper's method
    --inline    one thread, one pair after the other; same results
    --realtime  at the speed of the recording; late messages are dropped

    examples:
      replay drive.mcap --rig rig.toml --tum est.txt --cloud map.ply --plan plan.png
      replay drive.mcap --record out.mcap --method paper
      replay drive.mcap --rerun out.rrd
      replay drive.mcap --start-s 60 --seconds 20
    """
    config = settings_of(args)
    for warning in unused_settings(config, "replay", args.set):
        warn(warning)
    options = ReplayOptions(
        rig=args.rig,
        topics=(args.lower, args.upper),
        span_s=(args.start_s, math.inf if args.seconds is None else args.start_s + args.seconds),
        tum=args.tum,
        map_tum=args.map_tum,
        cloud=args.cloud,
        plan=args.plan,
        record=args.record,
        publish=args.publish,
        inline=args.inline,
        paced=args.realtime,
        drops=args.realtime,
        settings=args.config,
    )
    if args.rerun is None:
        return replay_and_print(args.log, config, options, args)
    if args.record is not None:
        raise OmnidError("--rerun and --record exclude each other: replay the log once for each")
    from omnid.commands.view import sink_of  # rerun may be missing

    with closing(sink_of(args.rerun, args.log)) as sink:
        from omnid.viewer.rerun_sink import ReplayDrawing

        drawn = replace(options, map_every_s=config.live.cloud_s, observer=partial(ReplayDrawing, sink))
        return replay_and_print(args.log, config, drawn, args)


def replay_and_print(log: Path, config: Config, options: ReplayOptions, args: argparse.Namespace) -> int:
    """Replay a log, print warnings on stderr and the summary on stdout, and return the exit code.

    args: --quiet, --verbose, and perhaps --json.
    """
    result = run_log(log, config, options if args.quiet else replace(options, progress=Progress()))
    for warning in result.warnings:
        warn(warning)
    if getattr(args, "json", False):
        found = {name: getattr(result, name) for name in ("counters", "warnings", "signal", "elapsed_s")}
        print_json(found | {"timings": {stage: row._asdict() for stage, row in result.timings.items()}})
    else:
        entries = summary_entries(result.counters, verbose=args.verbose)
        pairs_hz = result.counters.pairs / max(1e-3, result.elapsed_s)
        entries["speed"] = f"{pairs_hz:.1f} pairs/s, in {result.elapsed_s:.1f} s"
        if files := [path for _, path in options.files] + ([result.map_file] if result.map_file else []):
            entries["written"] = ", ".join(map(str, files))
        print(run_summary(entries, result.timings.values() if args.verbose else ()))
    return 128 + result.signal if result.signal else int(result.counters.no_pose or bool(result.counters.loss))
