"""Drives of one version before all that may stand in a way: `python -m tests.bench.obstacle_drives --seeds A B`.

What is driven follows from the seed alone (`plan`). Each drive is a line of build/results/obstacle_drives.jsonl; the
command goes on where it ended as long as the commit is the same. From all lines follow two tables: by what stands in
the way, and by robot, camera and floor.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
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


Drives = dict[str, Drive]  # by name


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


def add_table(name: str, by: str, key: Callable[[Planned], str], made: Sequence[Planned], drives: Drives) -> None:
    """Print and write the table in which drives of one key are a row; the last row has all of them."""
    table = ResultTable(name, f"Stops of the collision monitor, by {by}", (Column(by), *COLUMNS), REMARKS)
    table.seeds = sorted({("obstacle stops", planned.seed) for planned in made})
    for label in (*dict.fromkeys(map(key, made)), OF_ALL):
        chosen = [drives[planned.name] for planned in made if label in (key(planned), OF_ALL)]
        total = summed(chosen)
        stops = total.stops, total.false_stops
        contacts = total.contacts, total.own
        table.add(label, len(chosen), *contacts, total.clearance_m, *stops, total.driven_m, total.near_mps)


def main() -> None:
    """Make the drives that are missing, print a line for each, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, required=True, metavar=("FIRST", "LAST"))
    parser.add_argument("--jobs", type=int, default=1, help="drives at a time")
    arguments = parser.parse_args()
    here, drives = commit(), known_drives()
    seeds = range(arguments.seeds[0], arguments.seeds[1] + 1)
    wanted = [planned for seed in seeds for planned in plan(seed)]
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
    made_drives = [planned for planned in wanted if planned.name in drives]
    add_table("obstacle_drives", "what stands in the way", lambda planned: planned.case, made_drives, drives)
    add_table("obstacle_drives_kinds", "robot, camera and floor", lambda planned: planned.kind, made_drives, drives)


if __name__ == "__main__":
    main()
