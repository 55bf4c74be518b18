"""Rigs calibrated on one drive, tried on another: `python -m tests.bench.self_calibration DRIVE:TRIAL ...`.

DRIVE and TRIAL are folders of `python -m tests.simulation ... --mirrors`, of one seed and thus of the same rig. The
start is DRIVE/nominal.toml, or the file of that name by --rig; --perturbed: DRIVE/rig.toml with focal lengths 0.1 %,
centres 0.3 px, xi 0.5 % and the upper camera's tilt 0.1 degree off. ATE: of the path as a rigid body, and from the
first pose as `omnid eval` does it, which contains the direction of the rig frame. Sigma: of lengths, as the command
says. --sigmas: also the errors of each parameter in parts of its stated standard deviation, where the true cameras are
of the rig's model, and their rms.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

import omnid
from calib import se3
from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.models.camera import Array
from calib.models.unified import UnifiedCamera
from calib.rig import Rig
from calib.rig_file import read_rig
from omnid.calibration.drive import calibrate_drive
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.bench.results import Cell, Column, ResultTable
from tests.simulation.rigs import with_upper_rotated

COLUMNS: Final = (
    Column("drive"),
    Column("trial"),
    Column("error before", "px", 3),
    Column("error after", "px", 3),
    Column("misfit"),
    Column("model"),
    Column("length", "%", 3),
    Column("ATE (rigid)", "mm", 2),
    Column("ATE (first pose)", "mm", 2),
    Column("heading, max", "deg", 3),
    Column("stated sigma of lengths", "%", 2),
    Column("processor time", "s", 0),
)


def perturbed(rig: Rig) -> Rig:
    """Return a rig of unified cameras with errors: the horizon stays with xi, cameras err in opposite directions."""
    sides = []
    for mounted, sign in ((rig.lower, 1.0), (rig.upper, -1.0)):
        camera = mounted.camera
        assert isinstance(camera, UnifiedCamera)
        xi = camera.xi * (1 + sign * 0.005)
        fu, fv = (f * (1 + sign * 0.001) * xi / camera.xi for f in camera.focal)
        centre = camera.center[0] + 0.3, camera.center[1] - sign * 0.3
        sides.append(replace(mounted, camera=replace(camera, xi=xi, focal=(fu, fv), center=centre)))
    return with_upper_rotated(replace(rig, lower=sides[0], upper=sides[1]), (0.07, -0.07, 0.0))


def parameter_scores(found: Rig, truth: Rig) -> dict[str, float]:
    """Return the errors of a rig's parameters in parts of their stated standard deviations, by name.

    Both rigs have unified cameras. The baseline's length is left out: images do not show it.
    """
    assert found.covariance is not None
    # The parameters are those of a rig frame that stays with the lower camera.
    X = se3.inverse(truth.lower.T_cam_rig) @ found.lower.T_cam_rig
    lower, upper = (replace(mounted, T_cam_rig=mounted.T_cam_rig @ X) for mounted in (truth.lower, truth.upper))
    parameters, true = (
        RigParameters.about(rig, ("k1", "k2", "p1", "p2")) for rig in (found, replace(truth, lower=lower, upper=upper))
    )
    turned = parameters.transform_steps(true.rig) * parameters.units
    errors = dict(zip(parameters.names, (parameters.values - true.values - turned).tolist(), strict=True))
    return {name: errors[name] / found.covariance.sigma(name) for name in found.covariance.names if name in errors}


def row(drive: Path, trial: Path, start: Rig, scores: list[dict[str, float]] | None = None) -> list[Cell]:
    """Return one row of the table; add the errors of the parameters to scores."""
    started = time.process_time()
    found = calibrate_drive([drive / "log.mcap"], start, progress=lambda line: print(line, file=sys.stderr))
    spent_s = time.process_time() - started
    if scores is not None:
        scores.append(parameter_scores(found.rig, read_rig(drive / "rig.toml")))
    result = omnid.replay(trial / "log.mcap", found.rig)
    truth = read_tum(trial / "truth.txt")
    m = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), truth)
    common = np.isin(truth.stamps_ns, result.stamps_ns)
    rigid = rigid_error_m(result.T_odom_rig[:, :3, 3], truth.T[common, :3, 3])
    uncertainty = drive_uncertainty(found.rig)
    terms = (
        " ".join(
            sorted(
                {
                    name.split()[-1]
                    for name in found.adjustment.parameters.names
                    if name[-2:] in ("k1", "k2", "p1", "p2")
                }
            )
        )
        or "as the file"
    )
    return [
        drive.name,
        trial.name,
        found.first_sigma_px,
        found.adjustment.sigma_px,
        found.is_misfit,
        terms,
        100 * m.length_error_ratio,
        1e3 * rigid,
        1e3 * m.ate_rmse_m,
        math.degrees(m.heading_max_rad),
        100 * uncertainty.scale if uncertainty else None,
        spent_s,
    ]


def rigid_error_m(found: Array, truth: Array) -> float:
    """Return the rms distance of two paths (N, 3) after the best rotation and translation (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.sqrt(np.mean(((b - a @ R.T) ** 2).sum(axis=1))))


def main() -> None:
    """Print the table, each row as soon as it is measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pairs", nargs="+", metavar="DRIVE:TRIAL")
    parser.add_argument("--rig", default="nominal.toml", metavar="FILE", help="the start, in the folder DRIVE")
    parser.add_argument("--perturbed", action="store_true", help="start from the true rig with small errors")
    parser.add_argument("--sigmas", action="store_true", help="compare the errors of the parameters with their sigmas")
    args, scores = parser.parse_args(), list[dict[str, float]]()
    start_name = "a true rig with small errors" if args.perturbed else args.rig
    table = ResultTable("self_calibration", f"Self-calibration from drives, from {start_name}", COLUMNS)
    for pair in args.pairs:
        drive, trial = map(Path, pair.split(":"))
        start = perturbed(read_rig(drive / "rig.toml")) if args.perturbed else read_rig(drive / args.rig)
        table.add(*row(drive, trial, start, scores if args.sigmas else None), folder=drive)
    if scores:
        title = "Errors over stated standard deviations of drives"
        sigmas = ResultTable(
            "self_calibration_sigmas",
            title,
            (Column("parameter"), Column("rms", "", 2), Column("errors")),
        )
        sigmas.seeds = table.seeds
        for name in sorted({name for one in scores for name in one}):
            values = [one[name] for one in scores if name in one]
            sigmas.add(name, np.sqrt(np.mean(np.square(values))), " ".join(f"{one:+.2f}" for one in values))


if __name__ == "__main__":
    main()
