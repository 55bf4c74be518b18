"""Pose graphs with truth: loops close, wrong ones are left out, and the covariance tells the error."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from omnid.core.places.pose_graph import PoseEdges, PoseGraphResult, optimise
from tests.omnid.core.places.graphs import SIGMA_LOOP, joined, laps, without


def loops_of(found: PoseGraphResult) -> NDArray[np.bool_]:
    """Return flags of the loops of a run of `laps` that were accepted."""
    odometry_edges = len(found.poses) - 1
    return found.accepted[odometry_edges:]


@pytest.mark.parametrize("seed", [1, 2])
def test_loops_take_most_of_the_drift_away_and_wrong_ones_do_not_count(seed: int) -> None:
    run = laps(seed, nodes=400, per_lap=100, loops=60, wrong=0.1)
    found = optimise(run.start, run.edges)
    assert found.converged
    assert not loops_of(found)[~run.right].any()
    assert loops_of(found)[run.right].mean() > 0.95
    assert run.error_m(found.poses) < 0.3 * run.error_m(run.start)


def test_half_of_the_loops_may_be_wrong() -> None:
    run = laps(3, nodes=400, per_lap=100, loops=60, wrong=0.5)
    found = optimise(run.start, run.edges)
    assert not loops_of(found)[~run.right].any()
    assert loops_of(found)[run.right].mean() > 0.95


def test_wrong_loops_that_agree_with_each_other_do_not_bend_the_odometry() -> None:
    """As in two corridors that look the same, 15 m apart."""
    run = laps(4, nodes=400, per_lap=100, loops=30, wrong=0.0)
    pairs = np.column_stack([np.arange(5, 25), np.arange(55, 75)])
    twins = PoseEdges(
        pairs, np.tile(np.eye(4), (20, 1, 1)), np.tile(np.diag(SIGMA_LOOP**2), (20, 1, 1)), np.ones(20, bool)
    )
    accepted = loops_of(optimise(run.start, joined(run.edges, twins)))
    assert not accepted[30:].any()
    assert accepted[:30].mean() > 0.9


def test_the_covariance_of_the_last_node_is_that_of_its_error() -> None:
    """The squared Mahalanobis distance of the last pose is chi-squared with six degrees of freedom: mean 6."""
    squared = []
    for seed in range(25):
        run = laps(100 + seed, nodes=60, per_lap=20, loops=6, wrong=0.0)
        found = optimise(run.start, run.edges)
        error = se3.log(se3.inverse(found.poses[-1]) @ run.truth[-1])
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert 6 - 4 * np.sqrt(12 / 25) < np.mean(squared) < 6 + 4 * np.sqrt(12 / 25)


def test_fixed_nodes_stay_and_the_others_move_to_them() -> None:
    """A saved map of 100 nodes is fixed; a second session, 5 m off, comes to it by its loops."""
    run = laps(7, nodes=200, per_lap=100, loops=30, wrong=0.0)
    fixed = np.arange(200) < 100
    start = run.truth.copy()
    start[100:] = se3.exp([5, 3, 0, 0, 0, 0.5]) @ start[100:]
    cut = without(run.odometry, 99)
    found = optimise(start, joined(cut, run.loops), fixed)
    np.testing.assert_array_equal(found.poses[:100], start[:100])
    assert np.isfinite(found.covariance).all()
    assert run.error_m(found.poses) < 0.05


def test_the_same_graph_gives_the_same_bytes() -> None:
    run = laps(10, nodes=60, per_lap=20, loops=10, wrong=0.3)
    first, second = (optimise(run.start, run.edges) for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes() and first.covariance.tobytes() == second.covariance.tobytes()
