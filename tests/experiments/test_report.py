"""What the comparisons measure on small rendered logs, and that the committed report says what was measured."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from omnid.core.mapping.voxel_map import MapPoints
from omnid.formats.tum import read_tum
from tests.experiments import path_following, turn_tracking, wall_matching
from tests.experiments.report import RESULTS, about, report, text
from tests.experiments.scenes import build
from tests.experiments.tables import percent, spread
from tests.experiments.views import Experiment
from tests.experiments.whole_building import map_errors
from tests.simulation.recipes import Run

# Rendered by POV-Ray: render brick --seed 1 --size 512 --pairs 1, turns --size 448 --pairs 5 --supersample 3.
SMALL = Path(__file__).parent / "small"


@pytest.fixture(scope="module")
def wall() -> dict[str, Any]:
    return wall_matching.measure(SMALL / "brick_s1", Experiment.read(SMALL / "brick_s1"))


@pytest.fixture(scope="module")
def turns() -> list[dict[str, Any]]:
    return list(turn_tracking.measure(SMALL / "turns_s1", Experiment.read(SMALL / "turns_s1"))["turns"])


def test_enhanced_sad_has_at_most_a_third_of_the_wrong_matches_on_bricks(wall: dict[str, Any]) -> None:
    original, enhanced, omnid = (wall[name] for name in wall_matching.METHODS)
    assert original["wrong"] > 0.1
    assert enhanced["wrong"] < original["wrong"] / 3 and omnid["wrong"] < original["wrong"] / 3
    assert enhanced["completeness"] > max(0.8, original["completeness"])
    assert enhanced["rms_of_right_m"] < 0.03


def test_improved_tracking_holds_through_turns_where_plain_klt_fades(turns: list[dict[str, Any]]) -> None:
    plain, steps, correlation = ([row["found"][name]["right"] for row in turns] for name in turn_tracking.TRACKERS)
    assert [row["turn_deg"] for row in turns] == [0, 9, 18, 27]
    assert plain[3] < 0.7 * plain[0]
    for found in (steps, correlation):
        assert min(found) > 0.85 * found[1] > 0.8 * turns[1]["features"]


def test_claims_without_a_way_back_are_wrong_after_a_turn(turns: list[dict[str, Any]]) -> None:
    plain, steps = (turns[3]["found"][name] for name in ("plain KLT", "18° steps"))
    assert plain["claimed"] > 1.3 * plain["right"] and steps["claimed"] < 1.05 * steps["right"]


def test_a_path_is_followed_by_the_command_and_judged_against_the_truth() -> None:
    """The turns' log, on the spot: no length to speak of, all turned."""
    found = path_following.follow(SMALL / "turns_s1", path_following.METHODS["eq. 9 with keyframes"])
    assert found["coverage"] == 1 and found["heading_deg"] < 0.3 and found["ate_m"] < 0.01
    assert np.shape(found["xy"]) == np.shape(path_following.true_path(SMALL / "turns_s1")) == (5, 2)


@pytest.mark.parametrize("options", path_following.METHODS.values(), ids=list(path_following.METHODS))
def test_every_method_of_the_table_is_one_that_the_command_knows(options: tuple[str, ...], tmp_path: Path) -> None:
    from omnid.cli import main

    settings = [word for word in options if "=" in word or word == "--set"]
    assert main(["config", *settings]) == 0


def points_on(run: Run, off_m: float) -> MapPoints:
    """Points off_m in front of the first wall, in the frame of the first pose."""
    side = run.scene.rectangles[0]
    uv = np.random.default_rng(1).uniform(0.05, 0.95, (500, 2))
    world = side.points(uv) + off_m * side.normal
    xyz = (world - run.poses[0][:3, 3]) @ run.poses[0][:3, :3]
    ones = np.ones(len(xyz))
    return MapPoints(xyz.astype(np.float32), ones.astype(np.float32), ones.astype(np.int32), ones.astype(np.int32))


def test_the_map_is_judged_by_its_distance_from_what_stands_there() -> None:
    run = build("building", 3, 96)
    exact, off = map_errors(run, points_on(run, 0.0)), map_errors(run, points_on(run, 0.03))
    assert exact["rms_m"] < 1e-4 and exact["off_by_0.05_m"] == 0
    assert off["rms_m"] == pytest.approx(0.03, abs=0.005)
    assert 0.02 < exact["completeness"] < 0.3  # one wall of many


def test_a_report_is_made_of_what_is_there_and_nothing_is_measured_twice(tmp_path: Path) -> None:
    shutil.copytree(SMALL / "brick_s1", tmp_path / "logs" / "brick_s1")
    report(tmp_path / "logs", tmp_path / "results")
    data = tmp_path / "results" / "data" / "wall_brick_s1.json"
    assert data.exists() and (tmp_path / "results" / "brick.png").stat().st_size > 10_000
    data.write_text(data.read_text().replace('"seed":1', '"seed":7'))
    report(tmp_path / "logs", tmp_path / "results")
    assert '"seed":7' in data.read_text()


def test_the_committed_report_says_what_was_measured() -> None:
    assert (RESULTS / "README.md").read_text() == text(RESULTS)


def test_figures_carry_seed_date_and_machine() -> None:
    noted = about(Experiment.read(SMALL / "brick_s1"))
    assert noted["seed"] == 1 and "OpenCV" in noted["machine"] and len(noted["date"]) == 10


def test_a_spread_shows_median_smallest_and_largest() -> None:
    assert spread([0.03, 0.01, 0.02], percent(1)) == "2.0 % (1.0 % to 3.0 %)"
    assert spread([0.01], percent(2, sign=True)) == "+1.00 %"


def test_the_small_logs_hold_their_truth() -> None:
    assert len(read_tum(SMALL / "turns_s1" / "truth.txt").T) == 5
