"""Results follow the schema, have the roles of seeds.toml, and docs/results is made from them."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from tests.benchmark.results import FOLDER_VARIABLE, Column, ResultError, ResultTable, fault_of, read_result
from tests.benchmark.seeds import family_and_seed, role_of

COLUMNS = (Column("log"), Column("ATE rmse", "mm", 2), Column("good"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    return tmp_path


def test_each_row_is_printed_and_in_the_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = ResultTable("drive", "driving", "Drives", COLUMNS)
    table.add("rooms_s2", 0.12345678, True, folder=Path("rooms_s2"))
    assert read_result(folder / "drive.json")["rows"] == [["rooms_s2", 0.1234568, True]]
    table.add("two_walls_dim_s6", math.nan, None, folder=Path("two_walls_dim_s6"))
    result = read_result(folder / "drive.json")
    assert result["rows"][1] == ["two_walls_dim_s6", None, None]
    assert [(seed["family"], seed["seed"], seed["role"]) for seed in result["seeds"]] == [
        ("rooms", 2, "development"),
        ("two_walls", 6, "validation"),
    ]
    assert "| rooms_s2 | 0.12 | yes |\n| two_walls_dim_s6 |  |  |\n" in capsys.readouterr().out


def test_a_continued_table_keeps_the_rows_of_other_keys(folder: Path) -> None:
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        ResultTable("live", "speed", "Live", COLUMNS[:2], continued=True).add(key, value)
    assert read_result(folder / "live.json")["rows"] == [["b", 2], ["a", 3]]


def test_a_table_of_times_says_how_fast_the_machine_was(folder: Path) -> None:
    for name, question in (("drive", "driving"), ("live", "speed")):
        ResultTable(name, question, "Title", COLUMNS[:2]).add("a", 1)
    assert re.search(r", reference kernels [1-9]\d* ms$", read_result(folder / "live.json")["machine"])
    assert "reference" not in read_result(folder / "drive.json")["machine"]


def test_a_row_of_another_length_is_refused(folder: Path) -> None:
    with pytest.raises(ResultError, match="3 cells were expected, 2 given"):
        ResultTable("drive", "driving", "Drives", COLUMNS).add("rooms_s2", 0.1)


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("question", "weather", "a question of"),
        ("rows", [["a", 1]], "3 cells"),
        ("rows", [["a", [1], None]], "no number"),
        ("load", "high", "load: of another type"),
        ("extra", 1, "an object with the keys"),
        ("seeds", [{"family": "rooms", "seed": 2, "role": "held-out"}], "seeds.toml says development"),
    ],
)
def test_what_does_not_follow_the_schema_is_named(folder: Path, key: str, value: object, fault: str) -> None:
    ResultTable("drive", "driving", "Drives", COLUMNS).add("rooms_s2", 0.1, True)
    result = json.loads((folder / "drive.json").read_text())
    assert not fault_of(result)
    assert fault in fault_of(result | {key: value})


def test_roles_of_seeds() -> None:
    assert [role_of("rooms", seed) for seed in (2, 600, 899, 900)] == [
        "development",
        "validation",
        "validation",
        "held-out",
    ]
    assert role_of("two_walls", 8) == "validation" and role_of("struts", 8) == "development"


def test_recipe_and_seed_of_a_folder() -> None:
    assert family_and_seed("two_laps_384px_s604") == ("two_laps", 604)
    assert family_and_seed("rooms_m11") == ("rooms", 11)
    assert family_and_seed("recording") is None
