"""The plan of drives holds everything once, and its tables are the sums of the drives that were made."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from omnid.simulation.rendering.surfaces import Rectangle
from tests.bench.obstacle_drives import OF_ALL, add_table, plan
from tests.bench.obstacle_stops import CASES, FLOORS, PHOTOGRAPHS, TILES, Drive, world_of

SEEDS = (1, 2)


def test_every_case_is_driven_and_the_speeds_go_by_turns() -> None:
    drives = [planned for seed in range(4) for planned in plan(seed)]
    assert len({planned.name for planned in drives}) == len(drives)
    assert {case for case in CASES if not case.startswith("polished")} <= {planned.case for planned in drives}
    for kind in {planned.kind for planned in drives}:
        assert len({planned.conditions.speed_mps for planned in drives if planned.kind == kind}) == 4
    assert Counter(
        planned.conditions.speed_mps for planned in drives if planned.case == "box" and planned.kind == "usual"
    ) == {speed: 1 for speed in (0.3, 0.5, 0.8, -0.5)}


def test_the_table_sums_the_drives_that_were_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMNID_RESULTS", str(tmp_path))
    made = [planned for seed in SEEDS for planned in plan(seed) if planned.case == "box"]
    drives = {planned.name: Drive(1, 0, 0.25, 2, 1, 1.5, 0.4, (1, 2), "") for planned in made}
    add_table("drives", "case", lambda planned: planned.case, made, drives)
    assert f"| {OF_ALL} | {len(made)} | {len(made)} | 0 | 0.25 | {2 * len(made)} |" in capsys.readouterr().out


@pytest.mark.parametrize("case", ["free", "clutter"])
def test_a_floor_is_that_which_was_asked_for(case: str) -> None:
    """Rooms have a floor of their own choice where tiles, the usual ones, are asked for."""
    floors = {floor: _floor(case, floor) for floor in FLOORS if (case, floor) != ("clutter", TILES)}
    assert len({face.texture.tobytes() for face in floors.values()}) == len(floors)
    px_per_m = {floor: face.texture.shape[1] / face.width_m for floor, face in floors.items()}
    assert px_per_m.pop(PHOTOGRAPHS) > 400 and max(px_per_m.values()) < 130


def _floor(case: str, floor: str) -> Rectangle:
    world, _ = world_of(case, 3, floor)
    return next(part for part in world.standing if part.name == "floor")
