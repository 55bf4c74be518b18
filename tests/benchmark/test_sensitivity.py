"""The sensitivity table scales constants that exist, wherever they are used."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.benchmark import obstacle_sensitivity
from tests.benchmark.scaled_constant import SCALE, scale_in, scaled
from tests.benchmark.sensitivity import CONSTANTS, Trial, chosen, words_of

SOURCE = """
ONE, TWO = 4, 0.5
DOUBLE = 2 * ONE

class Limits:
    ratio: float = knob(0.9, "a share", low=0, high=1)
"""


def test_the_sixty_constants_exist_once() -> None:
    assert len(chosen()) == sum(map(len, CONSTANTS.values())) == 60


def test_the_constants_of_obstacles_exist_once_and_a_number_of_numpy_keeps_its_type() -> None:
    assert len(chosen(obstacle_sensitivity.CONSTANTS)) == sum(map(len, obstacle_sensitivity.CONSTANTS.values()))
    changed = scaled(np.uint8(48), 1.5)
    assert changed == 72 and isinstance(changed, np.uint8)


def test_a_row_has_the_shares_of_all_folders() -> None:
    found = {"all": [100, 5, 1], "things": [10, 5], "open": [80, 40, 20, 10], "free": [80, 30, 10, 0]}
    outcome = {"values": ["2", "3"], "found": {"a": found, "b": found}}
    row = obstacle_sensitivity.row(Trial("obstacles", None, 1.5, ("a", "b")), outcome)
    assert row[3:] == ["3", 50.0, 5.0, 1.0, 100.0, 75.0, 50.0, 0.0, ""]
    failed = obstacle_sensitivity.row(
        Trial("obstacles", None, 1.5, ("a",)), {"values": [], "found": {"a": {"error": "e"}}}
    )
    assert failed[-1] == "e" and failed[4] is None


def test_scales_before_other_constants_are_computed() -> None:
    tree = ast.parse(SOURCE)
    assert scale_in(tree, "ONE") and not scale_in(tree, "NONE") and scale_in(tree, "ratio")
    names = {SCALE: lambda value, highest=10.0: min(1.5 * value, highest), "knob": lambda value, *_, **__: value}
    exec(compile(ast.fix_missing_locations(tree), "a.py", "exec"), names)
    assert (names["ONE"], names["DOUBLE"], names["TWO"]) == (6.0, 12.0, 0.5)
    assert names["Limits"].ratio == 1


@pytest.mark.parametrize(
    ("value", "factor", "new"), [(3, 0.67, 2), (1, 0.67, 1), (0.3, 1.5, 0.45), ((2, 0.5), 1.5, (3, 0.75))]
)
def test_an_integer_stays_one_above_zero(value: object, factor: float, new: object) -> None:
    assert scaled(value, factor) == pytest.approx(new)


def test_a_process_runs_with_the_changed_value(tmp_path: Path) -> None:
    """A log that is missing is an outcome; the module was loaded with the changed constant by then."""
    words = ["odometry", "1.5", "omnid/core/odometry/corners.py", "CELL_PX", str(tmp_path / "none")]
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmark.scaled_constant", *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    outcome = json.loads(done.stdout)
    assert outcome["values"] == ["48", "72"] and "error" in outcome["found"][str(tmp_path / "none")]


def test_ratio_and_what_else_changed() -> None:
    trial = Trial("odometry", None, 1.5, ("a/rooms_384px_s1", "a/turns_384px_s1"))
    own = {
        "found": {
            trial.folders[0]: {"ate_mm": 1.0, "not_tracking": 0.0},
            trial.folders[1]: {"ate_mm": 2.0, "not_tracking": 0.0},
        }
    }
    changed = {"found": {trial.folders[0]: {"ate_mm": 4.0, "not_tracking": 0.5}, trial.folders[1]: {"error": "lost"}}}
    assert words_of(trial, own, changed) == (4.0, "rooms: 50 % not tracking; turns: lost")
