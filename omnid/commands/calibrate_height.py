"""`omnid calibrate height`: height and tilt of the cameras by the floor that they see."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from omnid.commands.height_option import height, height_of
from omnid.commands.options import command, log_with_rig, option, rig_of
from omnid.sinks.files import check_outputs


@command(
    *log_with_rig("a log in which the floor is seen all around"),
    option("--ruler-m", type=height, metavar="M", help="the same height by ruler, as a check"),
    option(
        "-o", "--output", type=Path, metavar="FILE", help="write the rig with that height; may be the file of --rig"
    ),
    examples=("calibrate height drive.mcap --rig rig.toml --ruler-m 0.92 -o rig.toml",),
)
def run(args: argparse.Namespace) -> int:
    """Print the height; return 1, and write nothing, where the ruler contradicts it."""
    from omnid.calibration.height import calibrate_height
    from omnid.engine.kernel_cache import prepare_kernels

    if args.output:
        check_outputs([("--output", args.output)], [("the log that is read", args.log)] * args.log.is_file())
    rig = rig_of(args)
    prepare_kernels()
    found = calibrate_height(args.log, rig, (args.lower, args.upper))
    print(found)
    print(f"the rig so far: {height_of(rig)}")
    if args.ruler_m is not None:
        contradiction = found.contradiction(args.ruler_m)
        if contradiction:
            print(f"omnid: {contradiction}; nothing was written", file=sys.stderr)
            return 1
        print(f"{args.ruler_m:.3f} m by ruler agrees")
    if args.output:
        found.save(args.output)
        print(f"{args.output}: written")
    return 0
