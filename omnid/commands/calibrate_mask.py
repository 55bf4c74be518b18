"""`omnid calibrate mask`: masks of what is fixed to the cameras, from a log in which the robot turns."""

from __future__ import annotations

import argparse
from pathlib import Path

from omnid.commands.options import command, log_with_rig, option, rig_of
from omnid.sinks.files import check_outputs


@command(
    *log_with_rig("a log in which the robot turns once on the spot"),
    option(
        "-o", "--output", type=Path, metavar="FILE", help="write the rig with these masks; may be the file of --rig"
    ),
    examples=("calibrate mask turn.mcap --rig rig.toml -o rig.toml",),
)
def run(args: argparse.Namespace) -> int:
    """Print how much of the panorama is fixed to a camera, and write the rig whose masks hide it."""
    from omnid.calibration.mask import calibrate_mask
    from omnid.engine.kernel_cache import prepare_kernels

    if args.output:
        check_outputs([("--output", args.output)], [("the log that is read", args.log)] * args.log.is_file())
    rig = rig_of(args)
    prepare_kernels()
    found = calibrate_mask(args.log, rig, (args.lower, args.upper))
    print(found)
    if args.output:
        found.save(args.output)
        print(f"{args.output}: written")
    return 0
