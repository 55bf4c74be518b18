"""The sensitivity table scales constants that exist, wherever they are used."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

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
