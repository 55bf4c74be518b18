"""Scores by which others compare trajectories: of the Hilti challenge of 2026, and drift as KITTI reports it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.recordings.evaluation import Metrics

Array = NDArray[np.float64]

HILTI_PER_M: Final = 0.46  # 100 exp(-0.46 error): half of the score is lost at 1.5 m
HILTI_COVERAGE: Final = 0.99  # share of the truth's poses that must have an estimate
# Lengths of KITTI's segments, which are scaled down for a way that is too short for the longest one, and the poses from
# one segment's begin to the next one's (Geiger et al. 2012, development kit of the odometry benchmark).
KITTI_LENGTHS_M: Final = tuple(100.0 * k for k in range(1, 9))
KITTI_EVERY: Final = 10


@dataclass(frozen=True, slots=True)
class Drift:
    """Mean errors of all segments of one length."""

    length_m: float
    segments: int
    translation_ratio: float  # of the length
    rotation_radpm: float


def hilti_score(metrics: Metrics) -> float:
    """Return the score, 0 to 100, of a run by its position error (ATE, rmse); 0 where poses are missing."""
    return 0.0 if metrics.coverage < HILTI_COVERAGE else 100.0 * math.exp(-HILTI_PER_M * metrics.ate_rmse_m)


def hilti_text(metrics: Metrics) -> str:
    """Return the score as a line, with the reason where it is 0."""
    missing = f": {metrics.coverage:.1%} of the truth have a pose, expected {HILTI_COVERAGE:.0%}"
    reason = missing if metrics.coverage < HILTI_COVERAGE else ""
    return f"score (Hilti 2026)    {hilti_score(metrics):.2f} of 100{reason}"


def kitti_drift(T_estimate: Array, T_true: Array) -> list[Drift]:
    """Return the drift over segments of 100 to 800 m of poses (N, 4, 4) at the same times; nothing where all stand.

    On a way shorter than 1000 m the lengths are a tenth to eight tenths of it. The error of a segment is that of the
    motion from its first to its last pose.
    """
    steps_m = np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    scale = min(1.0, float(way_m[-1]) / (KITTI_LENGTHS_M[-1] + 200.0))
    if scale == 0.0:
        return []
    begins = np.arange(0, len(T_true), KITTI_EVERY if scale == 1.0 else 1)
    found = []
    for length_m in (scale * length for length in KITTI_LENGTHS_M):
        ends = np.searchsorted(way_m, way_m[begins] + length_m)
        first, last = begins[ends < len(way_m)], ends[ends < len(way_m)]
        if not len(first):
            continue
        true = se3.inverse(T_true[first]) @ T_true[last]
        error = se3.inverse(true) @ se3.inverse(T_estimate[first]) @ T_estimate[last]
        found.append(
            Drift(
                length_m,
                len(first),
                float(np.linalg.norm(error[:, :3, 3], axis=1).mean()) / length_m,
                float(np.linalg.norm(se3.rotation_log(error[:, :3, :3]), axis=1).mean()) / length_m,
            )
        )
    return found


def drift_text(drift: list[Drift]) -> str:
    """Return a line for each length, and their mean as KITTI ranks by it."""
    lines = [
        f"drift over {one.length_m:8.2f} m {100 * one.translation_ratio:7.3f} %, "
        f"{math.degrees(one.rotation_radpm):.4f} deg/m ({one.segments} segments)"
        for one in drift
    ]
    count = sum(one.segments for one in drift)
    if not count:
        return "drift (KITTI)         undefined: the truth stands still"
    mean = sum(one.segments * one.translation_ratio for one in drift) / count
    turn = sum(one.segments * one.rotation_radpm for one in drift) / count
    return "\n".join([*lines, f"drift (KITTI)         {100 * mean:.3f} %, {math.degrees(turn):.4f} deg/m"])
