"""Attack the daemon: `python -m tests.bench.faults PART ...` measures tables and returns 1 where it did not hold.

Parts: stops (times from a cause to wheels at rest), commands (mutated commands), files (mutated files), images (drives
on tampered images, in lock-step). --only: of stops and images, those whose name has one of the words. --stops: so many
for each cause; --commands: mutated commands; --files: mutated files of each format; --images: seeds of each case;
--busy: so many other processes compute meanwhile. Faults of a live robot: `pytest -m slow
tests/bench/faults`. The campaign is seeded and bounded; by default it takes some hours.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from tests.bench.faults import hostile_commands, hostile_files, images, stop_times
from tests.bench.results import run
from tests.busy import busy_processes
from tests.simulation import build, write_log


def faults(
    parts: Sequence[Literal["stops", "commands", "files", "images"]],
    *,
    only: Sequence[str] = (),
    seed: int = 1,
    stops: int = 200,
    commands: int = 30_000,
    files: int = 10_000,
    images_: int = 3,
    busy: int = 0,
) -> int:
    """Run the parts; return 1 where one did not hold."""
    failed = 0
    with tempfile.TemporaryDirectory() as name, busy_processes(busy):
        folder = Path(name)
        # Without the turn of 94 degrees within 0.1 s at the end of this run, at which commands are void.
        made = build("two_walls", seed=3, size=256, pairs=24)
        write_log(folder / "scene", made.rig, made.poses[:22], made.scene, sensor=made.sensor, seed=3)
        if "stops" in parts:
            failed += stop_times.run(folder / "scene", folder, only, stops, seed)
        if "commands" in parts:
            failed += hostile_commands.run(folder / "scene", folder, commands, seed)
        if "files" in parts:
            failed += hostile_files.run(folder, files, seed)
        if "images" in parts:
            failed += images.run_all(only, images_, seed)
    return int(failed > 0)


if __name__ == "__main__":
    run(faults)
