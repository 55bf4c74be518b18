"""`omnid calibrate check`: compare a rig with its file by ordinary images, without a board."""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from calib.fit.rig_drift import apply_drift
from calib.masks.rim_check import RimShift
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid.calibration.images import SIDES, open_log
from omnid.calibration.rig_check import RigCheckResult, check_rig, moving_rig_finding, read_rig_pairs
from omnid.commands.options import cameras, command, option
from omnid.config import Config
from omnid.core.rig.column_finding import DRIFTED_PX, MIN_MATCHES, RigFinding
from omnid.core.rig.rig_state import RigState
from omnid.engine.kernel_cache import prepare_kernels
from omnid.errors import OmnidError
from omnid.messages import FramePair
from omnid.runs.log_rig import attached_rig
from omnid.sinks.files import check_outputs

# Most corrections of the upper camera's pose: each finds more points than the one before, as more of them match.
REFINEMENTS: Final = 3
# Median time between the exposures of the pairs: the stamps of cameras that are triggered together scatter by less.
MAX_SKEW_S: Final = 3e-3
# No mirror moves this far to the side, deg of the baseline; a camera's centre that is some pixels off has this effect.
NO_MIRROR_DEG: Final = 5.0
RECALIBRATE = "the cameras' intrinsics have changed, which a rotation does not correct: calibrate again with a board"
NOT_OBSERVABLE = (
    "not observable without a board: the length of the baseline (kept), the cameras' intrinsics, and the "
    "rig's pose on the robot"
)


@command(
    option("log", type=Path, metavar="LOG", help="a log of ordinary driving"),
    option("--rig", type=Path, metavar="FILE", help="the rig.toml; default: the one attached to the log"),
    *cameras("the {camera} camera's topic"),
    option("--refine", action="store_true", help="also correct the upper camera's pose, and write that rig"),
    option("-o", "--output", type=Path, help="with --refine: the rig.toml to write"),
    examples=("calibrate check drive.mcap --rig rig.toml",),
)
def run(args: argparse.Namespace) -> int:
    """Check the rig; return 0 if it fits, 1 if it has drifted or is broken."""
    if args.refine != (args.output is not None):
        raise OmnidError("calibrate check: --refine and -o go together: -o names the rig.toml that is written")
    if args.output:
        check_outputs([("--output", args.output)], [("the log that is read", args.log)] * args.log.is_file())
    named = read_rig(args.rig) if args.rig else None
    with closing(open_log(args.log, (args.lower, args.upper), named)) as reader:
        rig = named or attached_rig(reader, args.log)
        pairs = read_rig_pairs(reader, rig)
    skewed = _skewed(pairs)
    if skewed and args.refine:
        raise OmnidError(
            f"calibrate check: --refine would take motion for a drift: {skewed}; `omnid calibrate drive` "
            "calibrates such a rig"
        )
    prepare_kernels()
    found = check_rig(pairs, rig, Config().panorama)
    if skewed:
        # The motion between the exposures would be taken for a drift.
        found = replace(found, finding=moving_rig_finding(args.log, rig, (args.lower, args.upper), Config()))
    _require_matches(found.finding, len(pairs))
    print(report(found, len(pairs)))
    if skewed:
        print(f"{skewed}: the motion in between, as the odometry sees it, is allowed for")
    if args.refine:
        _refine(rig, pairs, found, args.output)
    return 0 if found.state is RigState.FITS else 1


def _skewed(pairs: list[FramePair]) -> str:
    """Return that the cameras are not synchronised; empty if they are."""
    skew_s = float(np.median([pair.skew_s for pair in pairs]))
    if abs(skew_s) < MAX_SKEW_S:
        return ""
    return f"the upper images are {1e3 * abs(skew_s):.1f} ms {'later' if skew_s > 0 else 'earlier'} than the lower ones"


def _require_matches(finding: RigFinding, pairs: int) -> None:
    if finding.state is RigState.UNCHECKED:
        raise OmnidError(
            f"calibrate check: expected at least {MIN_MATCHES} points in both panoramas, found "
            f"{finding.matches} of {finding.tried} in {pairs} pairs; use a log with more texture"
        )


def report(found: RigCheckResult, pairs: int) -> str:
    """Return the result as lines of text, the condition first."""
    finding = found.finding
    lines = [
        f"{found.state}: {pairs} pairs, {finding.matches} of {finding.tried} points found in both panoramas",
        f"columns: median {finding.offset_px:+.3f} px, spread {finding.spread_px:.3f} px; by azimuth, degrees to "
        "the left of forward:",
    ]
    lines.append(
        "  " + "  ".join(f"{azimuth:+.0f}: {median:+.2f}" for azimuth, median, count in finding.by_azimuth if count)
    )
    if finding.drift is not None:
        lines += _drift(finding)
        lines += [RECALIBRATE] * _intrinsics_changed(finding)
    lines += [_rim(name, rim) for name, rim in zip(SIDES, found.rims, strict=True)]
    return "\n".join(lines)


def _drift(finding: RigFinding) -> list[str]:
    """Return lines with the rotation and shift that explain the columns, their sigmas, and the remaining offsets."""
    assert finding.drift is not None
    drift = finding.drift
    turn, turn_sigma = np.rad2deg(drift.turn), np.rad2deg(drift.turn_sigma)
    shift, shift_sigma = np.rad2deg(drift.shift), np.rad2deg(drift.shift_sigma)
    rotation = ", ".join(
        f"{value:+.3f} ({sigma:.3f}) about {axis}" for value, sigma, axis in zip(turn, turn_sigma, "xyz", strict=True)
    )
    translation = ", ".join(
        f"{value:+.2f} ({sigma:.2f}) along {axis}" for value, sigma, axis in zip(shift, shift_sigma, "xy", strict=True)
    )
    return [
        f"upper camera: rotated by {finding.turn_deg:.3f} deg, sigma {np.rad2deg(drift.angle_sigma):.3f}: "
        f"{rotation}; z is along the baseline",
        f"upper viewpoint: shifted by {translation} deg, as seen from the lower one",
        f"remaining offset of the columns: {finding.left_px:.2f} px or less in half of all directions",
    ]


def _intrinsics_changed(finding: RigFinding) -> bool:
    """True if the columns show a change other than that of the upper camera's pose."""
    shift = np.zeros(2) if finding.drift is None else finding.drift.shift
    return finding.left_px > DRIFTED_PX or bool(np.rad2deg(np.linalg.norm(shift)) > NO_MIRROR_DEG)


def _rim(name: str, rim: RimShift | None) -> str:
    if rim is None:
        return f"{name} rim: not compared, as the mask or the rim in the images is not known"
    fits = "the mask fits"
    if not rim.fits:
        fits = "the mask reaches beyond the mirror: it was drawn so, or the camera has moved"
    return (
        f"{name} rim: centre moved by {rim.moved_px[0]:+.1f} {rim.moved_px[1]:+.1f} px from the mask's, radius "
        f"{rim.wider_px:+.1f} px: {fits}"
    )


def _refine(rig: Rig, pairs: list[FramePair], found: RigCheckResult, path: Path) -> None:
    """Correct the upper camera's pose by the drift, check again, and write the rig."""
    recalibrate = _intrinsics_changed(found.finding)
    for _ in range(REFINEMENTS):
        if found.finding.drift is None:
            raise OmnidError("calibrate check: too few points match to refine the rig; calibrate it again with a board")
        rig = apply_drift(rig, found.finding.drift)
        found = check_rig(pairs, rig, Config().panorama)
        sigma_rad = 0.0 if found.finding.drift is None else np.linalg.norm(found.finding.drift.turn_sigma)
        if found.finding.turn_deg < 2 * np.rad2deg(sigma_rad):
            break
    write_rig(path, rig)
    print(f"{path}: {found.finding.summary}\n{NOT_OBSERVABLE}")
    if recalibrate or found.finding.state is not RigState.FITS:
        print(RECALIBRATE)
