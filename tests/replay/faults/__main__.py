"""Inject faults into a running daemon: `python -m tests.replay.faults` prints a table of the results.

In each trial the operator drives and the fault comes; the wheels must stop, or go on as commanded, and the daemon must
recover by itself where it can. A trial that fails raises AssertionError.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.replay.faults import TRIALS
from tests.replay.faults.trial import Outcome, Setting
from tests.simulation import build, write_log


def scene(folder: Path) -> Path:
    """Render a small run into the folder."""
    run = build("two_walls", seed=3, size=256, pairs=24)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    return folder


def main() -> int:
    """Print the table as Markdown; return 1 where a trial has failed. Arguments: words in the names of the trials."""
    wanted = [name for name in TRIALS if not sys.argv[1:] or any(word in name for word in sys.argv[1:])]
    print("| fault | process | wheels | status |\n|---|---|---|---|", flush=True)
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        recorded = scene(Path(name) / "scene")
        for number, fault in enumerate(wanted):
            folder = Path(name) / str(number) / "in"
            folder.mkdir(parents=True)
            try:
                outcome = TRIALS[fault](Setting(recorded, folder))
            except AssertionError as error:
                failed += 1
                outcome = Outcome("FAILED", "", " ".join(str(error).split())[:200])
            print(f"| {fault} | {' | '.join(outcome)} |", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
