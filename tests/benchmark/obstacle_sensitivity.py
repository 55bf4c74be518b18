"""Sensitivity of the obstacle grid to its constants.

`python -m tests.benchmark.obstacle_sensitivity --folder DIR --seeds N`: each constant of CONSTANTS is multiplied by
0.67 and by 1.5, in a process of its own, on images that are rendered once: drives at true poses into rooms with one
thing each (tests/experiments/obstacle_posterior). Outcomes are kept in the folder, so that a series that was ended goes
on where it was; --minutes ends it. The share of what stands there that is called free (missed) may not grow; open
directions are to be called free. A constant of `*_kernels.py` takes longer, as its functions are compiled again.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from tests.benchmark.results import Cell, Column, ResultTable
from tests.benchmark.seeds import DEVELOPMENT, role_of
from tests.benchmark.sensitivity import FACTORS, Outcome, Trial, chosen, measured, rounded
from tests.experiments.obstacle_posterior.drives import keep_images, usual_robot

FAMILY: Final = "obstacle posterior"
CASES: Final = ("corridor", "low box", "bar", "table", "plain pole", "edge 8 cm", "glossy")
SIZE_PX, STEPS = 512, 40
# File below omnid/core/obstacles: the names of its constants. Those that state a format, a bound of memory or a unit
# are not in it, nor are those of people, of maps and of what is fixed to a camera.
CONSTANTS: Final = {
    "obstacles/column": (
        "UNSEEN_RUN",
        "LEAST_SEEN",
        "OUTLIER",
        "DIFFERENCE_RATIO",
        "THIN_M",
        "BIN_ROWS",
        "FLOOR_PX",
        "OTHERS_PX",
        "EDGE_M",
        "LEVEL_STEP_PX",
        "DEEP_STEP_PX",
        "DEEP_NOISE",
        "EVEN_SHARE",
        "LEVEL_RATIO",
        "ADJACENT_PX",
        "DISTANT_SHARE",
        "STRIP_ROWS",
        "STRIP_OVERLAP",
        "STRIP_BOUND",
        "STRIP_PRIOR",
        "FLOOR_WEIGHT",
        "LEAST_OTHERS",
    ),
    "obstacles/pair_views": (
        "FINE_PX",
        "COARSE_ROWS",
        "TEXTURE_SHARE",
        "CONTRAST_ROWS",
        "BAND_NOISE",
        "BOUNDED_SIGMAS",
    ),
    "obstacles/grid": ("SHOWN_RATE", "SHOWN_CELLS", "MOST_SHOWN", "APART_M", "END_BINS"),
    "obstacles/grid_layers": ("WIDE_CELLS", "EDGE_CELLS"),
    "obstacles/grid_ring": ("END_M",),
    "obstacles/near_field": ("PAST_SECTORS", "BEHIND_CELLS", "SEEN_SURFACE"),
    "obstacles/usual_floor": ("LEARNED", "HIDDEN_SUM", "HIDDEN_SHARE"),
    "obstacles/watch": ("MOST_FRESH", "LEAST_FRESH", "NARROW_CELLS"),
    "obstacles/cell_kernels": (
        "SURFACE_PRIOR",
        "VISIBLE_PRIOR",
        "LIMIT",
        "FLOOR_LOW",
        "EDGE_LOW",
        "MOST_RATIO",
        "NOISE_SURFACE",
        "UNSEEN_SURFACE",
        "CONTRADICTION",
        "PLACE_PAIRS",
    ),
    "obstacles/state_kernels": ("FREE_ODDS", "CLEAR_ODDS", "FREE_SHOWN", "SPECK_CELLS"),
}
COLUMNS: Final = (
    Column("constant"),
    Column("file"),
    Column("value"),
    Column("tried"),
    Column("of things missed", "%", 2),
    Column("of all missed", "%", 3),
    Column("false before it", "%", 2),
    Column("open and said so to 1 m", "%", 1),
    Column("1.5 m", "%", 1),
    Column("2 m", "%", 1),
    Column("3 m", "%", 1),
    Column("error"),
)
REMARKS: Final = (
    "Drives at true poses into seven rooms, with a corridor, a low box, a bar, a table, a plain pole, an edge of 8 cm "
    "and a glossy floor. Missed: called free beyond what stands there; of things: directions of the thing itself, at "
    "all ranges up to 4 m. A row that is as the first one shows that the constant decides nothing here, not that it is "
    "safe.",
)


def folder_of(top: Path, seed: int) -> Path:
    """Return the folder of the images of a seed, which are rendered where they are missing."""
    folder = top / f"posterior_{SIZE_PX}px_s{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    for case in CASES:
        if not (file := folder / f"{case}.npz").exists():
            keep_images(file, case, seed, usual_robot(SIZE_PX), STEPS)
    return folder


def trials(folders: tuple[str, ...]) -> Iterator[Trial]:
    """Yield all trials, that of the own values first."""
    yield Trial("obstacles", None, 1.0, folders)
    yield from (Trial("obstacles", constant, factor, folders) for constant in chosen(CONSTANTS) for factor in FACTORS)


def row(trial: Trial, outcome: Outcome) -> list[Cell]:
    """Return the row of a trial, summed over its folders."""
    name, file, value = "all as they are", "", ""
    if trial.constant is not None:
        name, value = trial.constant.name, trial.constant.value
        file = trial.constant.path.removeprefix("omnid/core/")
    head: list[Cell] = [name, file, value, rounded(outcome["values"][1]) if outcome["values"] else ""]
    found = list(outcome["found"].values())
    if errors := [one["error"] for one in found if "error" in one]:
        return [*head, *[None] * (len(COLUMNS) - len(head) - 1), errors[0][:60]]
    sums = {key: [sum(parts) for parts in zip(*(one[key] for one in found), strict=True)] for key in found[0]}
    (count, missed, false), (things, of_things) = sums["all"], sums["things"]
    free = [100 * n / max(is_open, 1) for n, is_open in zip(sums["free"], sums["open"], strict=True)]
    shares = [100 * n / max(of, 1) for n, of in ((of_things, things), (missed, count), (false, count))]
    return [*head, *shares, *free, ""]


def main() -> None:
    """Run what is not kept yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="of images and outcomes")
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which no trial is begun")
    args = parser.parse_args()
    if dev := [seed for seed in args.seeds if role_of(FAMILY, seed) == DEVELOPMENT]:
        parser.error(f"--seeds {dev[0]} is one of development, on which constants were set")
    end_s = time.monotonic() + 60 * args.minutes
    folders = tuple(str(folder_of(args.folder, seed)) for seed in args.seeds)
    file = args.folder / "outcomes.json"
    kept: dict[str, Outcome] = json.loads(file.read_text()) if file.exists() else {}
    table = ResultTable("obstacle_sensitivity", "obstacles", "Sensitivity to constants", COLUMNS, REMARKS, quiet=True)
    for trial in trials(folders):
        if trial.key not in kept and time.monotonic() < end_s:
            kept[trial.key] = measured(trial)
            file.write_text(json.dumps(kept, indent=1))
            print(row(trial, kept[trial.key]), flush=True)
        if trial.key in kept:
            table.rows.append(row(trial, kept[trial.key]))
    table.seeds = [(FAMILY, seed) for seed in args.seeds]
    print(table.save())


if __name__ == "__main__":
    main()
