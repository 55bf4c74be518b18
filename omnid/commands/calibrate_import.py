"""`omnid calibrate import`: the rigs of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from calib import se3
from calib.importers import import_chain, import_pair, read_transform, stacked_rig, straight_up
from calib.models.names import model_in_words
from calib.rig import Rig
from calib.rig_file import write_rig
from omnid.commands.options import HEIGHT, command, height_of, warn
from omnid.errors import OmnidError
from omnid.sinks.files import check_outputs


@command(HEIGHT)
def run(args: argparse.Namespace) -> int:
    """Make a rig.toml from a Kalibr file, from two OCamCalib files, or of two 360-degree cameras.

    camchain [FILE]  both cameras: Kalibr's camchain.yaml
    --lower CAMERA   the lower camera: its name in the camchain (cam0), or its file: OCamCalib's calib_results.txt
    --upper CAMERA   the same for the upper camera
    --equirectangular 3840x1920  two 360-degree cameras one above the other, with stitched images of this size; with
        --baseline
    --view mirror|direct        OCamCalib: the world is seen in a mirror (default) or directly through a lens
    --frame imu|cameras=imu     the rig frame of a file with T_cam_imu: that of the IMU, whose z must point up; cameras:
        the origin at the lower viewpoint, z to the upper one, x ahead
    -o, --output FILE           the rig.toml to write (required)
    --replace                   write it in the place of an existing file

    one of:
    --transform FILE  the 16 numbers of T_lower_upper, row by row
    --baseline M 0.001..5  metres from the lower viewpoint straight up to the upper one; both cameras look up and are
        equally oriented

    examples:
      calibrate import camchain.yaml -o rig.toml
      calibrate import --equirectangular 3840x1920 --baseline 0.2 -o rig.toml
    """
    read = [path for path in (args.camchain, args.lower, args.upper, args.transform) if path]
    check_outputs([("--output", args.output)], [("a file that is read", Path(path)) for path in read])
    rig = _imported(args)
    if args.height_m is not None:
        rig = rig.at_height(args.height_m)
    if args.output.exists() and not args.replace:
        raise OmnidError(f"--output {args.output} exists: --replace writes the rig in its place")
    write_rig(args.output, rig)
    print(f"{args.output}: {describe(rig)}")
    return 0


def _imported(args: argparse.Namespace) -> Rig:
    files = bool(args.transform or args.view)
    if args.equirectangular:
        if args.baseline is None or args.camchain or args.lower or args.upper or files:
            raise OmnidError("--equirectangular: expected --baseline METRES beside it, and no file")
        return stacked_rig(args.equirectangular, args.baseline)
    if args.camchain is not None:
        if files or args.baseline is not None:
            raise OmnidError("--transform, --baseline and --view belong to files of OCamCalib: Kalibr's state them")
        return import_chain(args.camchain, args.lower or "", args.upper or "", args.frame, warn)
    if not (args.lower and args.upper and (args.transform or args.baseline is not None)):
        raise OmnidError(
            "calibrate import: expected a Kalibr camchain.yaml, or two files of OCamCalib as --lower and --upper with "
            "--transform FILE or --baseline METRES"
        )
    T_lower_upper = read_transform(args.transform) if args.transform else straight_up(args.baseline)
    return import_pair(Path(args.lower), Path(args.upper), T_lower_upper, args.view or "mirror", warn)


def describe(rig: Rig) -> str:
    """Return one line about a rig: cameras, topics, baseline, rotation between the cameras, height."""
    T_upper_lower = rig.upper.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig)
    rotation_deg = np.rad2deg(np.linalg.norm(se3.rotation_log(se3.R_of(T_upper_lower))))
    lower, upper = (
        f"{model_in_words(mounted.camera)} {'x'.join(map(str, mounted.camera.size))}" + (f" ({topic})" if topic else "")
        for mounted, topic in zip((rig.lower, rig.upper), rig.topics, strict=True)
    )
    delay_ms = 1e3 * rig.times.upper_delay_s
    late = f"upper exposed {delay_ms:+.1f} ms against its stamps, " if delay_ms else ""
    return (
        f"lower {lower}, upper {upper}, baseline {rig.baseline_m * 1e3:.1f} mm, upper rotated by "
        f"{rotation_deg:.2f} deg, {late}{height_of(rig)}"
    )
