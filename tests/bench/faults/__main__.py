"""Attack the daemon: `python -m tests.bench.faults [PART ...]` measures tables and returns 1 where it did not hold.

Parts: trials (each fault once, its outcome), stops (times from a cause to wheels at rest), commands (mutated
commands), files (mutated files), images (drives on tampered images, in lock-step).
The campaign is seeded and bounded; with the numbers of the defaults it takes some hours.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.bench.faults import hostile_commands, hostile_files, images, stop_times
from tests.bench.faults.trials import TRIALS, Outcome, Setting
from tests.bench.results import Column, ResultTable
from tests.busy import busy_processes
from tests.simulation import build, write_log


def scene(folder: Path) -> Path:
    """Render a small run into the folder, without its turn of 94 degrees within 0.1 s, at which commands are void."""
    run = build("two_walls", seed=3, size=256, pairs=24)
    write_log(folder, run.rig, run.poses[:22], run.scene, sensor=run.sensor, seed=3)
    return folder


def run_trials(recorded: Path, folder: Path, words: list[str]) -> int:
    """Measure the outcome of each trial whose name has one of the words; return the number of failures."""
    columns = (Column("fault"), Column("process"), Column("wheels"), Column("status"))
    table = ResultTable("faults_trials", "Faults of a live robot", columns)
    failed = 0
    for number, fault in enumerate(name for name in TRIALS if not words or any(word in name for word in words)):
        own = folder / f"trial-{number}" / "in"
        own.mkdir(parents=True)
        try:
            outcome = TRIALS[fault](Setting(recorded, own))
        except AssertionError as error:
            failed += 1
            outcome = Outcome("FAILED", "", " ".join(str(error).split())[:200])
        table.add(fault, *outcome)
    return failed


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options."""
    result = argparse.ArgumentParser(prog="python -m tests.bench.faults", description=__doc__)
    parts = ("trials", "stops", "commands", "files", "images")
    result.add_argument("parts", nargs="*", choices=[*parts, []], default=parts, metavar="PART", help=", ".join(parts))
    result.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="WORD",
        help="of trials, stops and images, those whose name has the word; may be given several times",
    )
    result.add_argument("--seed", type=int, default=1)
    result.add_argument("--stops", type=int, default=200, help="stops to measure for each cause")
    result.add_argument("--commands", type=int, default=30_000, help="mutated commands to send")
    result.add_argument("--files", type=int, default=10_000, help="mutated files of each format")
    result.add_argument("--images", type=int, default=3, help="seeds of each case of tampered images")
    result.add_argument("--busy", type=int, default=0, metavar="N", help="keep N other processes busy meanwhile")
    return result


def main() -> int:
    """Run the parts; return 1 where one did not hold."""
    args = parser().parse_args()
    failed = 0

    with tempfile.TemporaryDirectory() as name, busy_processes(args.busy):
        recorded, folder = scene(Path(name) / "scene"), Path(name)
        if "trials" in args.parts:
            failed += run_trials(recorded, folder, args.only)
        if "stops" in args.parts:
            failed += stop_times.run(recorded, folder, args.only, args.stops, args.seed)
        if "commands" in args.parts:
            failed += hostile_commands.run(recorded, folder, args.commands, args.seed)
        if "files" in args.parts:
            failed += hostile_files.run(folder, args.files, args.seed)
        if "images" in args.parts:
            failed += images.run_all(args.only, args.images, args.seed)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
