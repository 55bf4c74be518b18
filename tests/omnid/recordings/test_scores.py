"""Scores of others: the challenge of 2026, and KITTI's drift."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from omnid.formats.tum import Trajectory
from omnid.recordings.evaluation import evaluate
from omnid.recordings.scores import drift_text, hilti_score, hilti_text, kitti_drift


def straight(step_m: float, count: int, turn_rad: float = 0.0) -> np.ndarray:
    """Return poses (N, 4, 4) of a drive with one step and one turn from pose to pose."""
    step, poses = se3.exp([step_m, 0, 0, 0, 0, turn_rad]), [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def test_the_score_falls_with_the_error_and_is_zero_where_poses_are_missing() -> None:
    stamps = np.arange(200, dtype=np.int64) * 10**8
    truth = Trajectory(stamps, straight(0.5, 200))
    metrics = evaluate(truth, truth)
    assert hilti_score(metrics) == 100.0
    assert hilti_score(replace(metrics, ate_rmse_m=1.0)) == pytest.approx(100 * math.exp(-0.46))
    assert hilti_score(replace(metrics, coverage=0.991)) == 100.0 and hilti_score(replace(metrics, coverage=0.985)) == 0
    assert hilti_text(metrics).endswith("100.00 of 100"), "a score above 0 needs no reason"
    assert hilti_text(replace(metrics, coverage=0.6)).endswith(
        "0.00 of 100: 60.0% of the truth have a pose, expected 99%"
    )


@pytest.mark.parametrize(("step_m", "count", "lengths"), [(0.5, 3001, range(100, 801, 100)), (0.1, 101, range(1, 9))])
def test_drift_is_the_share_of_the_way_and_the_turn_by_metre(step_m: float, count: int, lengths: range) -> None:
    """A way that is 1 % too long, and 0.01 degrees a metre; segments of a short drive are scaled down."""
    turn = math.radians(0.01) * step_m
    drift = kitti_drift(straight(1.01 * step_m, count), straight(step_m, count))
    assert [one.length_m for one in drift] == pytest.approx(list(lengths))
    assert [one.translation_ratio for one in drift] == pytest.approx([0.01] * 8, rel=0.11)  # whole steps
    assert all(one.rotation_radpm < 1e-9 for one in drift)
    turned = kitti_drift(straight(step_m, count, turn), straight(step_m, count))
    assert [one.rotation_radpm for one in turned] == pytest.approx([math.radians(0.01)] * 8, rel=0.11)
    assert "drift (KITTI)         1.0" in drift_text(drift)


def test_a_truth_that_stands_has_no_drift() -> None:
    still = np.tile(np.eye(4), (20, 1, 1))
    assert kitti_drift(still, still) == [] and "stands still" in drift_text([])
