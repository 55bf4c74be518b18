"""`omnid calibrate drive`: a better rig.toml from ordinary drives, without a board."""

from __future__ import annotations

import argparse
import math
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.fit.rig_uncertainty import drive_uncertainty
from calib.rig_file import read_rig, write_rig
from omnid.commands.height_option import HEIGHT, height_of, with_height
from omnid.commands.options import cameras, command, option
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs

if TYPE_CHECKING:
    from calib.rig import Rig
    from omnid.calibration.drive import DriveCalibration

# Error of the landmarks with the new rig, in parts of that with the old one. Free parameters always lower the error a
# little, so a smaller gain does not show a better rig.
SMALL_GAIN = 0.95


@command(
    option("logs", type=Path, nargs="+", metavar="LOG", help="drives with turns; 100 to 350 pairs"),
    option(
        "--rig",
        type=Path,
        metavar="FILE",
        help="the rig.toml to start from; a nominal one will do: mirror data sheet, centre of the images, baseline by "
        "ruler; default: the one attached to the first log",
    ),
    *cameras("the {camera} camera's topic"),
    option(
        "--distance-m",
        type=float,
        metavar="M",
        help="straight distance from the first to the last "
        "image of a single log: sets the baseline's length, which is kept otherwise",
    ),
    HEIGHT,
    option("-o", "--output", type=Path, required=True, metavar="FILE", help="the rig.toml to write"),
    examples=("calibrate drive drive.mcap --rig rig.toml -o better.toml",),
)
def run(args: argparse.Namespace) -> int:
    """Return 0 if a rig was written, and 1 if none fits the drives better than the one to start from."""
    from omnid.calibration.drive import calibrate_drive
    from omnid.engine.kernel_cache import prepare_kernels

    _check(args)
    start = _start(args)
    prepare_kernels()
    found = calibrate_drive(args.logs, start, (args.lower, args.upper), lambda line: print(line, file=sys.stderr))
    print("\n".join(describe(found)))
    if found.adjustment.sigma_px > SMALL_GAIN * found.first_sigma_px and not args.distance_m:
        print(f"{args.rig or 'the attached rig'} fits these drives as well as any rig: nothing was written")
        if args.height_m is not None:
            print(f"--height-m {args.height_m:g} was not applied: state it in T_base_rig of the rig.toml")
        return 1
    rig = found.rig
    if args.distance_m:
        rig = found.at_distance(args.distance_m)
        print(
            f"baseline {1e3 * found.rig.baseline_m:.2f} mm -> {1e3 * rig.baseline_m:.2f} mm by the known distance "
            f"({found.distance_m:.3f} m before)"
        )
    rig = with_height(rig, args)
    write_rig(args.output, rig)
    print(f"{args.output}: written, {height_of(rig)}")
    if found.is_misfit:
        print(
            f"{args.output}: warning: the model does not describe these cameras; calibrate with a board, and check "
            "the mirrors",
            file=sys.stderr,
        )
    return 0


def _start(args: argparse.Namespace) -> Rig:
    """Return the rig to start from; refuse logs that cannot be read."""
    from drivers.logs.log_reader import LogReader
    from omnid.runs.log_rig import attached_rig

    start = None if args.rig is None else read_rig(args.rig)
    for log in args.logs:
        with closing(LogReader(log, args.lower, args.upper)) as reader:
            start = start or attached_rig(reader, log)
    assert start is not None, "there is a log"
    return start


def _check(args: argparse.Namespace) -> None:
    inputs = [("the log that is read", log) for log in args.logs]
    rigs = [("the rig that is read", args.rig)] if args.rig is not None else []
    check_outputs([("--output", args.output)], [*inputs, *rigs])
    if args.distance_m is not None and not (math.isfinite(args.distance_m) and args.distance_m > 0):
        raise OmnidError(f"--distance-m {args.distance_m}: expected a distance above 0 m")
    if args.distance_m is not None and len(args.logs) > 1:
        raise OmnidError(f"--distance-m is the length of one drive; found {len(args.logs)} logs")


def describe(found: DriveCalibration) -> list[str]:
    """Return the result as lines of text: errors before and after, scale, and each parameter with its sigma."""
    adjustment, parameters = found.adjustment, found.adjustment.parameters
    misfit = "MISFIT: the residuals are not noise. " if found.is_misfit else ""
    uncertainty = drive_uncertainty(found.rig)
    lines = [
        f"{misfit}{found.drives.keyframes} keyframes, {len(adjustment.state.points)} landmarks, "
        f"{len(adjustment.observations)} observations; error {found.first_sigma_px:.3f} px before, "
        f"{adjustment.sigma_px:.3f} px after",
        *(f"{side}: {structure}" for side, structure in zip(("lower", "upper"), found.structure, strict=True)),
        f"lengths change by {100 * found.scale_change:+.3f} %" + (f"; {uncertainty}" if uncertainty else ""),
        f"{'parameter':<14}{'before':>14}{'after':>14}{'sigma':>11}",
    ]
    after = parameters.values + adjustment.state.steps * parameters.units
    sigmas = adjustment.sigmas * parameters.units
    rows = zip(parameters.names, parameters.values, after, sigmas, adjustment.seen.tolist(), strict=True)
    for name, old, new, sigma, seen in rows:
        unseen = "" if seen else "  the drive does not show it"
        lines.append(f"{name:<14}{old:>14.5f}{new:>14.5f}{sigma:>11.5f}{unseen}")
    if not np.all(adjustment.seen):
        lines.append("parameters that the drive does not show stay near their start")
    if found.times:
        times = ", ".join(f"{name} {value:.3g}" for name, value in found.times)
        lines.append(f"times of exposure: {times}: in the table [times] of the file, where runs read them")
    if found.level_rad:
        lines.append(
            f"the rig frame was turned by {np.rad2deg(found.level_rad):.2f} deg, so that the drive lies in "
            "the x-y plane of the base"
        )
    return lines
