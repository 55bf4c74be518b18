"""`omnid calibrate check`: whether a rig is still as its file has it, from ordinary images, without a board."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from calib.fit.rig_drift import corrected
from calib.masks.rim_check import RimShift
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from omnid.calibration.image_pairs import SIDES
from omnid.calibration.log_rig_check import RigCheckResult, look, open_log, read_pairs_of
from omnid.config import Config
from omnid.core.rig.rig_check import DRIFTED_PX, MIN_MATCHES, RigFinding
from omnid.errors import OmnidError
from omnid.messages import FramePair
from omnid.runs.log_rig import attached_rig
from omnid.sinks.files import check_outputs

REFINEMENTS = 3
# A mirror does not move so far aside; a camera's centre that is some pixels off looks as if it had.
NO_MIRROR_DEG = 5.0
ANEW = "the cameras' own parameters have changed, which no turn makes good: calibrate anew with a board"
UNKNOWN = ("not to be known without a board: the baseline's length (kept), the cameras' own parameters, and the rig's "
           "place on the robot")


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `check` to `omnid calibrate`."""
    parser = actions.add_parser("check", help="whether a rig is still as its file has it, without a board")
    parser.add_argument("log", type=Path, metavar="LOG", help="a log of ordinary driving")
    parser.add_argument("--rig", type=Path, metavar="FILE", help="the rig.toml; without it, the one in the log")
    parser.add_argument("--lower", metavar="TOPIC", help="the lower camera's topic")
    parser.add_argument("--upper", metavar="TOPIC", help="the upper camera's topic")
    parser.add_argument("--refine", action="store_true", help="also turn the upper camera into its place, and write "
                        "that rig")
    parser.add_argument("-o", "--output", type=Path, help="with --refine: the rig.toml to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """0 where the rig is good, 1 where it has drifted or is broken."""
    if args.refine != (args.output is not None):
        raise OmnidError("calibrate check: --refine and -o go together: -o names the rig.toml that is written")
    if args.output:
        check_outputs([("--output", args.output)], [("the log that is read", args.log)] * args.log.is_file())
    named = read_rig(args.rig) if args.rig else None
    reader = open_log(args.log, (args.lower, args.upper), named)
    try:
        rig = named or attached_rig(reader, args.log)
        pairs = read_pairs_of(reader, rig)
    finally:
        reader.close()
    found = look(pairs, rig, Config().panorama)
    _require_matches(found.finding, len(pairs))
    print(report(found, len(pairs)))
    if args.refine:
        _refine(rig, pairs, found, args.output)
    return 0 if found.good else 1


def _require_matches(finding: RigFinding, pairs: int) -> None:
    if finding.verdict == "unknown":
        raise OmnidError(f"calibrate check: only {finding.matches} of {finding.tried} points of {pairs} pairs are "
                         f"found in both panoramas, {MIN_MATCHES} are needed; take a log where there is more to see")


def report(found: RigCheckResult, pairs: int) -> str:
    """What was found, some lines of text, the verdict first."""
    finding = found.finding
    lines = [f"{_verdict(found)}: {pairs} pairs, {finding.matches} of {finding.tried} points found in both panoramas",
             f"columns: median {finding.offset_px:+.3f} px, spread {finding.spread_px:.3f} px; by azimuth, degrees to "
             "the left of forward:"]
    lines.append("  " + "  ".join(f"{azimuth:+.0f}: {median:+.2f}" for azimuth, median, count in finding.by_azimuth
                                  if count))
    if finding.drift is not None:
        lines += _drift(finding)
        lines += [ANEW] * _bent(finding)
    lines += [_rim(name, rim) for name, rim in zip(SIDES, found.rims, strict=True)]
    return "\n".join(lines)


def _verdict(found: RigCheckResult) -> str:
    return "drifted" if found.finding.verdict == "good" and not found.good else found.finding.verdict


def _drift(finding: RigFinding) -> list[str]:
    """The turn and shift that explain the columns, with their deviations, and what they leave."""
    assert finding.drift is not None
    drift = finding.drift
    turn, shift = np.rad2deg(drift.turn), np.rad2deg(drift.shift)
    sure = np.rad2deg(drift.turn_sigma), np.rad2deg(drift.shift_sigma)
    axes = ", ".join(f"{value:+.3f} ({sigma:.3f}) about {axis}" for value, sigma, axis in zip(turn, sure[0], "xyz",
                                                                                           strict=True))
    aside = ", ".join(f"{value:+.2f} ({sigma:.2f}) along {axis}" for value, sigma, axis in zip(shift, sure[1], "xy",
                                                                                            strict=False))
    return [f"upper camera: turned by {finding.turn_deg:.3f} deg: {axes}; z is along the baseline",
            f"upper viewpoint: aside by {aside} deg, as seen from the lower one",
            f"columns once that is taken away: off by {finding.left_px:.2f} px or less in half of all directions"]


def _bent(finding: RigFinding) -> bool:
    """Whether more than the upper camera's place must have changed."""
    shift = np.zeros(2) if finding.drift is None else finding.drift.shift
    return finding.left_px > DRIFTED_PX or bool(np.rad2deg(np.linalg.norm(shift)) > NO_MIRROR_DEG)


def _rim(name: str, rim: RimShift | None) -> str:
    if rim is None:
        return f"{name} rim: not compared, as the mask or the rim in the images is not known"
    fits = "the mask fits" if rim.fits else "the mask reaches beyond the mirror: drawn so, or the camera has moved"
    return (f"{name} rim: centre moved by {rim.moved_px[0]:+.1f} {rim.moved_px[1]:+.1f} px from the mask's, radius "
            f"{rim.wider_px:+.1f} px: {fits}")


def _refine(rig: Rig, pairs: list[FramePair], found: RigCheckResult, path: Path) -> None:
    """Turns the upper camera as the drift says, looks again, and writes the rig."""
    bent = _bent(found.finding)
    for _ in range(REFINEMENTS):
        if found.finding.drift is None:
            raise OmnidError("calibrate check: too few points match to refine the rig; calibrate it anew with a board")
        rig = corrected(rig, found.finding.drift)
        found = look(pairs, rig, Config().panorama)
        if found.finding.turn_deg < 2 * np.rad2deg(np.linalg.norm(_sigma(found.finding))):
            break
    write_rig(path, rig)
    print(f"{path}: {found.finding.summary}\n{UNKNOWN}")
    if bent or found.finding.verdict != "good":
        print(ANEW)


def _sigma(finding: RigFinding) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.zeros(3) if finding.drift is None else finding.drift.turn_sigma
