"""Faults injected into a running daemon, and what became of each: `python -m tests.replay.faults` prints the table.

In each the operator drives, the fault comes, the wheels must come to a stand or go on as asked, and where it can the
daemon recovers by itself. A fault that went wrong raises AssertionError.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.replay.faults import TRIALS
from tests.replay.faults.trial import Outcome, Place
from tests.simulation import build, write_log


def scene(folder: Path) -> Path:
    """A small rendered run."""
    run = build("two_walls", seed=3, size=256, pairs=24)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    return folder


def main() -> int:
    """Prints the table as Markdown; 1 where a trial has failed. Words: only the trials whose names hold one of them."""
    wanted = [name for name in TRIALS if not sys.argv[1:] or any(word in name for word in sys.argv[1:])]
    print("| fault | process | wheels | what the status said |\n|---|---|---|---|", flush=True)
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        recorded = scene(Path(name) / "scene")
        for number, fault in enumerate(wanted):
            folder = Path(name) / str(number) / "in"
            folder.mkdir(parents=True)
            try:
                outcome = TRIALS[fault](Place(recorded, folder))
            except AssertionError as error:
                failed += 1
                outcome = Outcome("FAILED", "", " ".join(str(error).split())[:200])
            print(f"| {fault} | {' | '.join(outcome)} |", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
