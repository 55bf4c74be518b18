"""Attack the daemon: `python -m tests.bench.faults [PART ...]` measures tables and returns 1 where it did not hold.

Parts: stops (times from a cause to wheels at rest), commands (mutated commands), files (mutated files), images (drives
on tampered images, in lock-step). Faults of a live robot: `pytest -m slow tests/bench/faults/test_live_faults.py`.
The campaign is seeded and bounded; with the numbers of the defaults it takes some hours.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.bench.faults import hostile_commands, hostile_files, images, stop_times
from tests.busy import busy_processes
from tests.simulation import build, write_log


def scene(folder: Path) -> Path:
    """Render a small run into the folder, without its turn of 94 degrees within 0.1 s, at which commands are void."""
    run = build("two_walls", seed=3, size=256, pairs=24)
    write_log(folder, run.rig, run.poses[:22], run.scene, sensor=run.sensor, seed=3)
    return folder


def parser() -> argparse.ArgumentParser:
    """Return the parser of the options."""
    result = argparse.ArgumentParser(prog="python -m tests.bench.faults", description=__doc__)
    parts = ("stops", "commands", "files", "images")
    result.add_argument("parts", nargs="*", choices=[*parts, []], default=parts, metavar="PART", help=", ".join(parts))
    result.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="WORD",
        help="of stops and images, those whose name has the word; may be given several times",
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
