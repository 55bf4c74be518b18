"""Drives of one version before all that may stand in a way: `python -m tests.bench.obstacle_drives --seeds A B`.

What is driven follows from the seed alone (`plan`). Each drive is a line of build/results/obstacle_drives.jsonl; the
command goes on where it ended as long as the commit is the same. From all lines follow the published tables: by what
stands in the way, by that and the speed, and by robot, camera and floor. With --real only the drives with all
disturbances of images are made, which have a table of their own.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from typing import Final, NamedTuple

from tests.bench.cluttered_room import AT_EDGE, CLUTTER, WITH_PEOPLE
from tests.bench.corridor_worlds import CROSSING, POLISHED, SPEED_MPS
from tests.bench.fine_robot import BUILDS, USUAL
from tests.bench.floating_boxes import KINDS
from tests.bench.furniture import FURNITURE
from tests.bench.obstacle_stops import FLOORS, TILES, Conditions, Drive, run, summed
from tests.bench.real_lenses import OF_CAMERAS
from tests.bench.results import ROOT, Column, ResultTable, commit

LINES: Final = ROOT / "build" / "results" / "obstacle_drives.jsonl"
SPEEDS_MPS: Final = (SPEED_MPS, 0.8, -SPEED_MPS, 0.3)  # by turns
EDGES: Final = ("edge 8 cm", "edge 15 cm", "edge 30 cm", "edge 50 cm")
STANDING: Final = ("box", "low box", "plain pole", "pole", "white wall", *EDGES, "ramp", *KINDS)
PEOPLE: Final = ("person at 0.8 m", "person at 1.5 m", *CROSSING)
ROOMS: Final = (CLUTTER, AT_EDGE, WITH_PEOPLE)
# Where floor, robot or camera are others, each of these meets each of them.
CHOSEN: Final = ("free", "low box", "edge 8 cm", "bar", "plain pole", "table", "chair", "person crosses", CLUTTER)
USUALLY: Final = Conditions()
# What a table by speed tells apart; each of its rows is one of these at one speed.
GROUPS: Final[dict[str, tuple[str, ...]]] = {
    "poles": ("plain pole", "pole"),
    "bars and tines": tuple(kind for kind in KINDS if kind != "table"),
    "edges": EDGES,
    "boxes": ("box", "low box"),
    "tables and furniture": ("table", *FURNITURE),
    "people": PEOPLE,
}
BY_SPEED: Final = [f"{group}, {speed:g} m/s" for group in GROUPS for speed in sorted(SPEEDS_MPS)]
FINE: Final = Conditions(size_px=960, rate_hz=30.0)
REAL: Final = Conditions(disturbed=OF_CAMERAS, turns_first=True)
OF_ALL: Final = "all drives"
COLUMNS: Final = (
    Column("drives"),
    Column("contacts"),
    Column("of the robot's own"),
    Column("least clearance", "m", 2),
    Column("stops"),
    Column("false stops"),
    Column("driven", "m", 1),
    Column("highest speed within 1 m of it", "m/s", 2),
)
REMARKS: Final = (
    "A simulated robot by the stick, straight on, at 0.3, 0.5, 0.8 and -0.5 m/s (backwards) by turns, 512 px at 10 Hz; "
    "only the collision monitor keeps it from what it meets. A contact counts for an edge when the outline is over it; "
    "of a person, either of the two may have moved; it is the robot's own where it drove faster than 0.05 m/s. A stop "
    "is false where the truth has nothing within 1 m ahead, or up to 0.2 m to the side of the way, and no person walks "
    "within 2 m. What a row does not name is as usual: tiles, matt; a robot 1.2 m high; cameras without compression.",
)


class Planned(NamedTuple):
    """A drive that is to be made."""

    case: str
    seed: int
    conditions: Conditions

    @property
    def name(self) -> str:
        """Name of the drive in LINES."""
        return f"{self.case} {self.seed} {self.conditions}"

    @property
    def group(self) -> str:
        """Return what stands in the way, in short, and the speed; empty: a room, a corridor, a white wall or a ramp."""
        case = self.case.removeprefix(POLISHED)
        group = next((group for group, cases in GROUPS.items() if case in cases), "")
        return f"{group}, {self.conditions.speed_mps:g} m/s" if group else ""

    @property
    def kind(self) -> str:
        """Robot, camera and floor."""
        if self.case.startswith(POLISHED):
            return "polished floor"
        return str(replace(self.conditions, speed_mps=SPEED_MPS)) or "usual"


def plan(seed: int) -> list[Planned]:
    """Return all drives of a seed: speeds go by turns over drives and seeds."""
    every: list[tuple[str, Conditions]] = [
        *((case, USUALLY) for case in (*STANDING, *PEOPLE, *ROOMS, "free", *FURNITURE)),
        *((case, Conditions(floor=floor)) for floor in FLOORS if floor != TILES for case in CHOSEN),
        *((case, Conditions(build=build)) for build in BUILDS if build != USUAL for case in CHOSEN),
        *((case, Conditions(disturbed=("jpeg",))) for case in CHOSEN),
        *((case, REAL) for case in CHOSEN),
        *((POLISHED + case, USUALLY) for case in ("free", "box", "pole", "person crosses")),
        *((case, FINE) for case in ("free", "low box", "edge 8 cm", "plain pole", "person crosses")),
    ]
    return [
        Planned(case, seed, replace(how, speed_mps=SPEEDS_MPS[(seed + number) % len(SPEEDS_MPS)]))
        for number, (case, how) in enumerate(every)
    ]


def known_drives() -> dict[str, Drive]:
    """Return the drives of this commit that LINES has, by name."""
    lines = (json.loads(line) for line in LINES.read_text().splitlines()) if LINES.exists() else ()
    here = commit()
    return {line["name"]: Drive(**line["drive"]) for line in lines if line["commit"] == here}


def of_real_images(planned: Iterable[Planned]) -> list[Planned]:
    """Return the drives with all disturbances of images."""
    return [one for one in planned if one.kind == str(REAL)]


class Grouping(NamedTuple):
    """A table: drives of one key are a row."""

    name: str
    by: str
    key: Callable[[Planned], str]  # empty: in no row
    order: Sequence[str] = ()  # of the rows; empty: that of the drives


BY_CASE: Final = "what stands in the way"
GROUPINGS: Final = (
    Grouping("obstacle_drives", BY_CASE, lambda planned: planned.case),
    Grouping("obstacle_drives_speeds", f"{BY_CASE} and speed", lambda planned: planned.group, BY_SPEED),
    Grouping("obstacle_drives_kinds", "robot, camera and floor", lambda planned: planned.kind),
)
OF_REAL: Final = (Grouping("obstacle_drives_real", f"{BY_CASE}, with {REAL}", lambda planned: planned.case),)


def tables(made: Sequence[Planned], drives: dict[str, Drive], *, real: bool = False) -> list[ResultTable]:
    """Return the tables of drives that were made: GROUPINGS; real: that of real images."""
    found = []
    for name, by, key, order in OF_REAL if real else GROUPINGS:
        table = ResultTable(name, f"Stops of the collision monitor, by {by}", (Column(by), *COLUMNS), REMARKS)
        shown = [planned for planned in made if key(planned)]
        table.seeds = sorted({("obstacle stops", planned.seed) for planned in shown})
        known = dict.fromkeys(map(key, shown))
        for label in (*(label for label in order or known if label in known), OF_ALL):
            total = summed(chosen := [drives[planned.name] for planned in shown if label in (key(planned), OF_ALL)])
            clearance_m, driven_m, near_mps = (round(x, 3) for x in (total.clearance_m, total.driven_m, total.near_mps))
            stops = total.stops, total.false_stops
            table.rows.append([label, len(chosen), total.contacts, total.own, clearance_m, *stops, driven_m, near_mps])
        found.append(table)
    return found


def main() -> None:
    """Make the drives that are missing, print a line for each, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, required=True, metavar=("FIRST", "LAST"))
    parser.add_argument("--real", action="store_true", help="only the drives with all disturbances of images")
    parser.add_argument("--jobs", type=int, default=1, help="drives at a time")
    arguments = parser.parse_args()
    here, drives = commit(), known_drives()
    seeds = range(arguments.seeds[0], arguments.seeds[1] + 1)
    wanted = [planned for seed in seeds for planned in plan(seed)]
    wanted = of_real_images(wanted) if arguments.real else wanted
    missing = [planned for planned in wanted if planned.name not in drives]
    LINES.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool, LINES.open("a") as lines:
        waiting = {pool.submit(run, *planned): planned for planned in missing}
        for future in as_completed(waiting):
            name, made = waiting[future].name, future.result()
            drives[name] = made
            print(f"{name}: {made}", flush=True)
            lines.write(json.dumps({"commit": here, "name": name, "drive": made._asdict()}) + "\n")
            lines.flush()
    for table in tables([planned for planned in wanted if planned.name in drives], drives, real=arguments.real):
        print(table.save())


if __name__ == "__main__":
    main()
