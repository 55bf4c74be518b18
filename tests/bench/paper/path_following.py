"""V.C, fig. 9: the path between two walls, and the contribution of each step from the paper's method to omnid's."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import evaluate
from tests.bench.paper.estimation import Method, estimate
from tests.bench.paper.views import Experiment

SAD, ENHANCED = "stereo.matching.method=sad", "stereo.matching.method=enhanced"
PAPER, KLT, KEYFRAME = "odometry.method=paper", "odometry.tracker=klt", "odometry.reference=keyframe"
METHODS: dict[str, Method] = {
    "original SAD, plain KLT, eq. 9": Method((PAPER, SAD, KLT)),
    "enhanced SAD, plain KLT, eq. 9": Method((PAPER, ENHANCED, KLT)),
    "original SAD, improved KLT, eq. 9": Method((PAPER, SAD)),
    "enhanced SAD, improved KLT, eq. 9 (the paper)": Method((PAPER, ENHANCED)),
    "the paper without its Kalman filter": Method((PAPER, ENHANCED), filtered=False),
    "eq. 9 with keyframes": Method((PAPER, ENHANCED, KEYFRAME)),
    "bearings, frame to frame": Method(("odometry.limits.keyframes=1",)),
    "bearings, keyframes, enhanced SAD": Method((ENHANCED,)),
    "bearings, keyframes, semi-global prior (omnid)": Method(),
    "omnid without the Kalman filter": Method(filtered=False),
}
THE_PAPER = METHODS["enhanced SAD, improved KLT, eq. 9 (the paper)"]


def measure(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """Return the errors of the path for each method."""
    return {name: against_truth(estimate(folder, method)[0], folder) for name, method in METHODS.items()}


def against_truth(trajectory: Trajectory, folder: Path) -> dict[str, Any]:
    """Return the errors of a trajectory."""
    m = evaluate(trajectory, read_tum(folder / "truth.txt"))
    return {
        "length_m": m.length_estimate_m,
        "true_length_m": m.length_truth_m,
        "length_error": m.length_error_ratio,
        "ate_m": m.ate_rmse_m,
        "end_m": m.end_error_m,
        "heading_deg": math.degrees(m.heading_max_rad),
        "coverage": m.coverage,
    }
