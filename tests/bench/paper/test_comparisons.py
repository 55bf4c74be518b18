"""Tests of the comparisons on small rendered logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from omnid.core.mapping.voxel_map import MapPoints
from omnid.runs.replay import ReplayOptions, run_log
from tests.bench.paper import path_following, turn_tracking, wall_matching
from tests.bench.paper.estimation import Method, estimate
from tests.bench.paper.scenes import build
from tests.bench.paper.views import Experiment
from tests.bench.paper.whole_building import map_errors
from tests.simulation.recipes import SimulatedRun

# Rendered by POV-Ray: render brick --seed 1 --size 512 --pairs 1, turns --size 448 --pairs 5 --supersample 3.
SMALL = Path(__file__).parent / "small"


@pytest.fixture(scope="module")
def wall() -> dict[str, Any]:
    return wall_matching.measure(SMALL / "brick_s1", Experiment.read(SMALL / "brick_s1"))


@pytest.fixture(scope="module")
def turns() -> dict[float, dict[str, Any]]:
    rows = turn_tracking.measure(SMALL / "turns_s1", Experiment.read(SMALL / "turns_s1"))["turns"]
    return {row["turn_deg"]: row for row in rows}


def right(turns: dict[float, dict[str, Any]], tracker: str) -> dict[float, int]:
    return {turn_deg: row["found"][tracker]["right"] for turn_deg, row in turns.items()}


def test_enhanced_sad_has_at_most_a_third_of_the_wrong_matches_on_bricks(wall: dict[str, Any]) -> None:
    original, enhanced, omnid = (wall[name] for name in wall_matching.SAD_METHODS)
    assert original["wrong"] > 0.1
    assert enhanced["wrong"] < original["wrong"] / 3 and omnid["wrong"] < original["wrong"] / 3
    assert enhanced["completeness"] > max(0.8, original["completeness"])
    assert enhanced["coverage"] > original["coverage"]
    assert enhanced["rms_of_right_m"] < 0.03


@pytest.mark.parametrize("sign", [1, -1])
def test_searches_keep_features_through_turns_where_plain_klt_loses_them(
    turns: dict[float, dict[str, Any]], sign: int
) -> None:
    angles_deg = [0.0, *(sign * a for a in (9.0, 18.0, 27.0))]
    assert set(angles_deg) <= set(turns)
    plain = right(turns, "plain KLT")
    assert plain[angles_deg[3]] < 0.7 * plain[0]
    for tracker in ("18° steps", "correlation"):
        found = right(turns, tracker)
        assert min(found[a] for a in angles_deg) > 0.85 * found[angles_deg[1]]
        assert found[angles_deg[1]] > 0.8 * turns[angles_deg[1]]["features"]


def test_a_trajectory_is_compared_with_the_truth() -> None:
    """Use the log of the turns: the rig stays in place and turns."""
    method = path_following.METHODS["eq. 9 with keyframes"]
    found = path_following.against_truth(estimate(SMALL / "turns_s1", method)[0], SMALL / "turns_s1")
    assert found["coverage"] == 1 and found["heading_deg"] < 0.3 and found["ate_m"] < 0.01


def test_the_stages_alone_give_the_poses_and_the_map_of_a_replay() -> None:
    trajectory, points = estimate(SMALL / "turns_s1", Method())
    options = ReplayOptions(rig=SMALL / "turns_s1" / "rig.toml", collect=True, inline=True)
    result = run_log(SMALL / "turns_s1" / "log.mcap", Method().config, options)
    np.testing.assert_array_equal(trajectory.T, result.T_odom_rig)
    assert points is not None and result.map is not None
    np.testing.assert_array_equal(points.xyz, result.map.xyz)


@pytest.mark.parametrize("overrides", [(), ("odometry.method=paper",)], ids=["omnid", "paper"])
def test_without_the_filter_the_trajectory_differs_a_little(overrides: tuple[str, ...]) -> None:
    filtered, unfiltered = (estimate(SMALL / "turns_s1", Method(overrides, filtered=f))[0] for f in (True, False))
    assert not np.array_equal(filtered.T, unfiltered.T)
    np.testing.assert_allclose(filtered.T, unfiltered.T, atol=0.01)


@pytest.mark.parametrize("method", path_following.METHODS.values(), ids=list(path_following.METHODS))
def test_every_method_of_the_table_is_a_valid_configuration(method: Method) -> None:
    assert method.config.stereo.matching.method in {"auto", *wall_matching.SAD_METHODS.values()}


def points_on(run: SimulatedRun, off_m: float) -> MapPoints:
    """Return points off_m in front of the first wall, in the frame of the first pose."""
    side = run.scene.rectangles[0]
    uv = np.random.default_rng(1).uniform(0.05, 0.95, (500, 2))
    world = side.points(uv) + off_m * side.normal
    xyz = (world - run.poses[0][:3, 3]) @ run.poses[0][:3, :3]
    ones = np.ones(len(xyz))
    return MapPoints(xyz.astype(np.float32), ones.astype(np.float32), ones.astype(np.int32), ones.astype(np.int32))


def test_map_errors_are_distances_from_the_true_surfaces() -> None:
    run = build("two_walls", 3, 96)
    exact, off = map_errors(run, points_on(run, 0.0)), map_errors(run, points_on(run, 0.03))
    assert exact["rms_m"] < 1e-4 and exact["off_by_0.05_m"] == 0
    assert off["rms_m"] == pytest.approx(0.03, abs=0.005)
    assert 0.1 < exact["completeness"] < 0.5  # one wall of two, and of their ends
