"""`omnid calibrate drive`: what drives say about a rig, without a board, and the rig that they make."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing

from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid.calibration.drive import calibrate_drive
from omnid.calibration.from_log import calibrate_height, calibrate_mask
from omnid.calibration.images import open_log
from omnid.calibration.rig_check import check_log, with_upper_corrected
from omnid.commands.options import HEIGHT, LOG_CAMERAS, command, failed, height_of, log_cameras, warn
from omnid.core.rig.column_finding import RigState
from omnid.engine.kernel_cache import prepare_kernels
from omnid.errors import OmnidError
from omnid.runs.session import attached_rig
from omnid.sinks.files import check_outputs


@command(LOG_CAMERAS, HEIGHT)
def run(args: argparse.Namespace) -> int:
    """Adjust all parameters of a rig to drives with turns, without a board.

    Then find the height of the cameras, if the rig states none, and what is fixed to them, where the first log shows
    it. Exit code 1: the rig has drifted (--only check), the ruler contradicts, or nothing was found that could be
    written.

    logs LOG...        drives with turns; 100 to 350 pairs
    --rig FILE         the rig.toml to start from; a nominal one will do: mirror data sheet, centre of the images,
        baseline by ruler; default: the one attached to the first log
    --only check|height|mask...  only this, by the first log; may be repeated. check: compare the rig with the images,
        and correct the upper camera's pose; height: height and tilt of the cameras by the floor; mask: hide what is
        fixed to the cameras, by a log in which the robot turns once
    --ruler-m M 0.1..10     the height by ruler, as a check of that by the floor
    -o, --output FILE  the rig.toml to write; may be the file of --rig

    examples:
      calibrate drive drive.mcap --rig rig.toml -o better.toml
      calibrate drive drive.mcap --only check
      calibrate drive drive.mcap --only height --ruler-m 0.92 --rig rig.toml -o rig.toml
    """
    # 1. The rig to start from.
    if args.output is not None:
        check_outputs([("--output", args.output)], [("the log that is read", log) for log in args.logs])
    if args.rig is not None:
        start = read_rig(args.rig)
    else:
        with closing(open_log(args.logs[0], log_cameras(args), None)) as reader:
            start = attached_rig(reader, args.logs[0])
    prepare_kernels()
    # 2. Check the rig, or adjust all of it.
    rig, has_drifted = start, False
    if not args.only:
        rig = _adjusted(args, rig)
    elif "check" in args.only:
        rig, has_drifted = _checked(args, rig)
    # 3. Find the height, and the masks; a log that shows none of them is no error but for --only.
    rig, contradiction = _at_height(args, rig)
    if not args.only or "mask" in args.only:
        try:
            mask = calibrate_mask(args.logs[0], rig, log_cameras(args))
            print(mask)
            rig = mask.rig if mask.share or args.only else rig
        except OmnidError as error:
            if args.only:
                raise
            print(error)
    # 4. Write the rig.
    if contradiction:
        return failed(f"{contradiction}; nothing was written")
    if args.output is not None and rig is start:
        print("nothing was written")
    elif args.output is not None:
        write_rig(args.output, rig)
        print(f"{args.output}: written, {height_of(rig)}")
    is_found = rig is not start or bool(args.only)
    return 0 if is_found and not has_drifted else 1


def _adjusted(args: argparse.Namespace, rig: Rig) -> Rig:
    """Return the rig that fits the drives best; the same one if none fits them better."""
    found = calibrate_drive(args.logs, rig, log_cameras(args), lambda line: print(line, file=sys.stderr))
    print("\n".join(found.lines()))
    if not found.is_better:
        print(f"{args.rig or 'the attached rig'} fits these drives as well as any rig")
        return rig
    if found.is_misfit:
        warn("the model does not describe these cameras; calibrate with a board, and check the mirrors")
    return found.rig


def _checked(args: argparse.Namespace, rig: Rig) -> tuple[Rig, bool]:
    """Return the rig, with its upper camera's pose corrected if it is to be written, and whether it had drifted."""
    found, pairs = check_log(args.logs[0], rig, log_cameras(args))
    print(found)
    if args.output is not None:
        rig, remains = with_upper_corrected(rig, pairs, found)
        print(f"{args.output}: {remains}")
    return rig, found.finding.state is not RigState.FITS


def _at_height(args: argparse.Namespace, rig: Rig) -> tuple[Rig, str]:
    """Return the rig with the height that is given, or else by the floor, and how the ruler contradicts it ("").

    Without --only, a height that the rig states is kept, and a floor that is not seen is no error.
    """
    if args.height_m is not None:
        return rig.at_height(args.height_m), ""
    is_wanted = args.ruler_m is not None or "height" in args.only
    if not is_wanted and (args.only or rig.height_m() is not None):
        return rig, ""
    try:
        found = calibrate_height(args.logs[0], rig, log_cameras(args))
    except OmnidError as error:
        if is_wanted:
            raise
        print(error)
        return rig, ""
    print(found)
    print(f"the rig so far: {height_of(rig)}")
    if args.ruler_m is not None:
        contradiction = found.contradiction(args.ruler_m)
        if contradiction:
            return rig, contradiction
        print(f"{args.ruler_m:.3f} m by ruler agrees")
    return found.rig, ""
