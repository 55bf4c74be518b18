"""The plan of drives holds everything once, and its tables are the sums of the drives that were made."""

from __future__ import annotations

from collections import Counter

import pytest

from omnid.simulation.rendering.surfaces import Rectangle
from tests.bench.obstacle_drives import CHOSEN, OF_ALL, of_real_images, plan, tables
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


def test_tables_sum_the_drives_that_were_made() -> None:
    made = plan(1)[:40] + plan(2)[:10]
    drives = {
        planned.name: Drive(number % 2, number % 3 == 0, number / 10, 2, 1, 1.5, 0.4, (1, 2), "")
        for number, planned in enumerate(made)
    }
    by_case, by_speed, by_kind = tables(made, drives)
    for table in (by_case, by_kind):
        *parts, whole = table.rows
        assert whole == [OF_ALL, 50, 25, 17, 0.0, 100, 50, 75.0, 0.4]
        assert [sum(row[k] for row in parts) for k in (1, 2, 3, 5, 6, 7)] == [50, 25, 17, 100, 50, 75.0]  # type: ignore[misc]
        assert table.seeds == [("obstacle stops", 1), ("obstacle stops", 2)]
    box = next(row for row in by_case.rows if row[0] == "box")
    assert box[1:5] == [2, sum(drives[planned.name].contacts for planned in made if planned.case == "box"), 1, 0.0]
    edges = {row[0]: row[1] for row in by_speed.rows if str(row[0]).startswith("edges")}
    assert list(edges) == [f"edges, {speed} m/s" for speed in ("-0.5", "0.3", "0.5", "0.8")]
    assert sum(edges.values()) == sum("edge" in planned.case for planned in made if "clutter" not in planned.case)  # type: ignore[misc]


def test_drives_with_real_images_have_a_table_of_their_own() -> None:
    chosen = of_real_images(plan(1))
    assert [one.case for one in chosen] == list(CHOSEN) and all(one.conditions.turns_first for one in chosen)
    (table,) = tables(chosen, {one.name: Drive(0, 0, 0.3, 1, 0, 2.0, 0.4, (1, 2), "") for one in chosen}, real=True)
    assert table.name == "obstacle_drives_real" and table.rows[-1] == [OF_ALL, 9, 0, 0, 0.3, 9, 0, 18.0, 0.4]


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
