"""`omnid eval`: errors of an estimated trajectory against the ground truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Final

from omnid.commands.json_output import add_json, print_json

# Position error (ATE), as a share of the true length, above which the trajectories hardly are of one drive: odometry
# that is lost half of the way is below.
ANOTHER_DRIVE: Final = 0.25


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `eval` to the command line."""
    parser = subparsers.add_parser("eval", help="compare a trajectory with the truth, both in the TUM format")
    parser.add_argument("estimate", type=Path, metavar="EST", help="t x y z qx qy qz qw, T_odom_rig")
    parser.add_argument("truth", type=Path, metavar="TRUTH",
                        help="the same format, of the same rig frame in any world frame")
    parser.add_argument("--tolerance-ms", type=float, default=10.0, metavar="MS",
                        help="largest difference between the stamps of two poses; default %(default)s")
    parser.add_argument("--align", choices=("origin", "rigid", "scale"), default="origin", help="the first pose "
                        "(default), as evo's --align_origin; rigid: all positions, as its --align; scale: these and "
                        "the estimate's scale, as its --align --correct_scale")
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the errors."""
    from omnid.formats.tum import read_tum
    from omnid.recordings.evaluation import evaluate

    metrics = evaluate(read_tum(args.estimate), read_tum(args.truth), args.tolerance_ms * 1e-3, args.align)
    if metrics.ate_rmse_m > ANOTHER_DRIVE * metrics.length_truth_m:
        print(f"omnid: warning: the estimate is off by {metrics.ate_rmse_m:.2f} m on a way of "
              f"{metrics.length_truth_m:.2f} m: is this the truth of the same drive, in the same frame of the robot?",
              file=sys.stderr)
    if args.json:
        print_json(metrics)
    else:
        print(metrics)
    return 0
