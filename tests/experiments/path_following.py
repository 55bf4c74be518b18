"""V.C, fig. 9: the length of the path between two walls, and what each step from the paper to omnid contributes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.benchmark.accuracy import omnid
from tests.experiments import figures as images
from tests.experiments.views import Experiment

KLT = ("--method", "paper", "--tracker", "klt")
PAPER = ("--method", "paper")
METHODS: dict[str, tuple[str, ...]] = {
    "original SAD, plain KLT, eq. 9": (*KLT, "--set", "stereo.matching.method=sad"),
    "enhanced SAD, plain KLT, eq. 9": KLT,
    "original SAD, improved KLT, eq. 9": (*PAPER, "--set", "stereo.matching.method=sad"),
    "enhanced SAD, improved KLT, eq. 9 (the paper)": PAPER,
    "eq. 9 with keyframes": (*PAPER, "--set", "odometry.reference=keyframe"),
    "bearings, frame to frame": ("--set", "odometry.limits.keyframes=1"),
    "bearings, keyframes, enhanced SAD": ("--set", "stereo.matching.method=enhanced"),
    "bearings, keyframes, semi-global prior (omnid)": (),
}


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """For each method: length and ATE and so on, and the path it found (for the image)."""
    return {name: follow(folder, options) for name, options in METHODS.items()}


def follow(folder: Path, options: Sequence[str]) -> dict[str, Any]:
    """What `omnid replay` with some options makes of a log, against its truth."""
    with tempfile.TemporaryDirectory() as work:
        estimate = Path(work) / "estimate.txt"
        omnid("replay", folder / "log.mcap", "--rig", folder / "rig.toml", "--tum", estimate, "--quiet", *options)
        return against_truth(read_tum(estimate), folder) | {"options": " ".join(options)}


def against_truth(estimate: Trajectory, folder: Path) -> dict[str, Any]:
    """The errors of a trajectory and the path in the frame of the first pose, x y [m]."""
    m = evaluate(estimate, read_tum(folder / "truth.txt"))
    return {"length_m": m.length_estimate_m, "true_length_m": m.length_truth_m, "length_error": m.length_error_ratio,
            "ate_m": m.ate_rmse_m, "end_m": m.end_error_m, "heading_deg": math.degrees(m.heading_max_rad),
            "coverage": m.coverage, "xy": np.round(estimate.T[:, :2, 3], 5).tolist()}


SHOWN = tuple(METHODS)[1], tuple(METHODS)[3], tuple(METHODS)[-1]


def draw(folder: Path, experiment: Experiment, path: Path) -> None:
    """The paths of plain KLT, of the paper and of omnid over the true one."""
    found = {name: follow(folder, METHODS[name])["xy"] for name in SHOWN}
    images.paths(found, true_path(folder), path)


def true_path(folder: Path) -> list[list[float]]:
    """The true path in the frame of its first pose, x y [m]."""
    poses = read_tum(folder / "truth.txt").T
    return [list(map(float, T[:2, 3])) for T in np.linalg.inv(poses[0]) @ poses]

