"""`python -m tests.simulation NAME --seed N --out DIR [--size 768] [--pairs N]` renders a log with ground truth."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from tests.simulation.logs import write_log
from tests.simulation.recipes import RECIPES, build


def main() -> None:
    """Render one recipe into a folder."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation",
                                     description="Render a log with exact ground truth.")
    parser.add_argument("name", choices=sorted(RECIPES))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="folder for log.mcap, camchain.yaml and truth.txt")
    parser.add_argument("--size", type=int, default=768, help="width and height of the images [px]")
    parser.add_argument("--pairs", type=int, help="number of stereo pairs")
    parser.add_argument("--supersample", type=int, default=3, help="samples per pixel and axis")
    arguments = parser.parse_args()
    run = build(arguments.name, arguments.seed, arguments.size, arguments.pairs)
    started = time.monotonic()

    def progress(done: int, total: int) -> None:
        left_s = (time.monotonic() - started) / done * (total - done)
        sys.stderr.write(f"\r{arguments.name} {done}/{total} pairs, {left_s:.0f} s left  ")

    write_log(arguments.out, run.rig, run.poses, run.scene, sensor=run.sensor, seed=arguments.seed,
              supersample=arguments.supersample, progress=progress)
    sys.stderr.write("\n")


if __name__ == "__main__":
    main()
