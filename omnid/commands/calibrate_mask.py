"""`omnid calibrate mask`: masks of what is fixed to the cameras, from a log in which the robot turns."""

from __future__ import annotations

import argparse
from pathlib import Path

from omnid.commands.log_options import add_log_with_rig, rig_of
from omnid.sinks.files import check_outputs


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `mask` to `omnid calibrate`."""
    parser = actions.add_parser("mask", help="masks of what is fixed to the cameras, such as reflections of lenses")
    add_log_with_rig(parser, "a log in which the robot turns once on the spot")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write the rig with these masks; may be the file of --rig"
    )
    parser.set_defaults(run=run)


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
