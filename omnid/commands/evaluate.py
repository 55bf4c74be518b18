"""`omnid eval`: errors of an estimated trajectory against the ground truth."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Final

from omnid.commands.options import JSON, command, print_json, warn
from omnid.errors import OmnidError
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.recordings.truth_frame import find_truth_frame

# Position error (ATE), as a share of the true length, above which the trajectories hardly are of one drive: odometry
# that is lost half of the way is below.
ANOTHER_DRIVE: Final = 0.25


@command(JSON)
def run(args: argparse.Namespace) -> int:
    """Compare a trajectory with the truth, both in the TUM format.

    estimate EST           t x y z qx qy qz qw, T_odom_rig
    truth TRUTH            the same format or EuRoC's CSV, of the same rig frame in any world frame
    --tolerance-ms MS=10   largest difference between the stamps of two poses
    --align origin|rigid|scale=origin  the first pose, as evo's --align_origin; rigid: all positions, as its --align;
        scale: these and the estimate's scale, which is printed, as its --align --correct_scale
    --live FILE            the poses as they were known while driving (replay --map-live-tum), whose errors are printed
        beside
    --frame rig|auto=rig   the body whose truth it is: the rig; auto: fit one constant pose of another body on the
        robot, and unit, delay and convention of the file, and print what was fitted

    examples:
      eval est.txt truth.txt
      eval est.txt imu_truth.csv --frame auto
      eval est.txt truth.txt --align rigid --json
      eval map.txt truth.txt --live live.txt
    """
    estimate, truth, tolerance_s = read_tum(args.estimate), read_tum(args.truth), args.tolerance_ms * 1e-3
    frame = find_truth_frame(estimate, truth)
    of_rig = truth if frame is None else frame.rig_poses(truth, estimate)
    if args.frame == "auto":
        truth = of_rig
    try:
        metrics = evaluate(estimate, truth, tolerance_s, args.align)
    except OmnidError as error:
        raise OmnidError(f"{error} {args.truth}: {frame}: --frame auto" if frame else str(error)) from error
    live = evaluate(read_tum(args.live), truth, tolerance_s, args.align) if args.live else None
    if frame is not None and args.frame == "rig":
        fitted = evaluate(estimate, of_rig, tolerance_s, args.align)
        warn(
            f"{args.truth}: {frame}: with that the position error is {1e3 * fitted.ate_rmse_m:.1f} mm instead of "
            f"{1e3 * metrics.ate_rmse_m:.1f}: --frame auto"
        )
    elif metrics.ate_rmse_m > ANOTHER_DRIVE * metrics.length_truth_m:
        warn(
            f"the estimate is off by {metrics.ate_rmse_m:.2f} m on a way of {metrics.length_truth_m:.2f} m: is this "
            "the truth of the same drive?"
        )
    if args.json:
        known = {"explained_by": None if frame is None else str(frame), "frame": args.frame}
        known |= {} if frame is None else {"fitted_unknowns": frame.freedom}
        print_json(asdict(metrics) | known | ({} if live is None else {"live": asdict(live)}))
        return 0
    if frame is not None and args.frame == "auto":
        print(f"{args.truth}: {frame}")
        if frame.freedom:
            print(f"unknowns of it that were fitted to these poses: {frame.freedom}; the errors are optimistic")
    print(metrics)
    if live is not None:
        print(f"as known while driving, of {args.live}\n{live}")
    return 0
