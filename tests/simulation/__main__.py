"""`python -m tests.simulation NAME --seed N --out DIR [--size 768] [--pairs N]` renders a log with ground truth.

Cameras that are not synchronised: `--speed 1.4 --skew-ms 15`, or `--skew-ms 5 25` (first and last pair); a rolling
shutter of 20 ms on 768 rows: `--line-time-us 26`. Real mirrors: `--mirrors`, with nominal.toml instead of rig.toml.
Real lenses, lamps and electronics: `--real`, or some of `tests/simulation/disturbances.py` by `--disturb flicker dust`.
Photographs on walls, floor and pictures: `--photographs`.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from calib.rig import ShutterTimes
from calib.rig_file import write_rig
from tests.simulation.disturbances import DISTURBANCES
from tests.simulation.logs import Readout, write_log
from tests.simulation.photographs import with_photographs
from tests.simulation.recipes import DIM, RECIPES, build
from tests.simulation.rigs import with_real_mirrors


def main() -> None:
    """Render one recipe into a folder."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.simulation", description="Render a log with exact ground truth."
    )
    parser.add_argument("name", choices=sorted(RECIPES))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="folder for log.mcap, camchain.yaml and truth.txt")
    parser.add_argument("--size", type=int, default=768, help="width and height of the images [px]")
    parser.add_argument("--pairs", type=int, help="number of stereo pairs")
    parser.add_argument("--supersample", type=int, default=3, help="samples per pixel and axis")
    parser.add_argument(
        "--mirrors",
        type=float,
        nargs="?",
        const=1.0,
        default=0.0,
        metavar="AMOUNT",
        help="tilted cameras below ray-traced mirrors that are off shape; 1: 0.7 deg, 1.5 %%, 3 px",
    )
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        help="factor on the speed; at 1 two_walls has 0.5 m/s and rooms about 0.57 m/s and 36 deg/s",
    )
    parser.add_argument(
        "--skew-ms",
        type=float,
        nargs="+",
        default=[0.0],
        metavar="MS",
        help="upper minus lower exposure and stamp, of all pairs or of the first and the last one",
    )
    parser.add_argument(
        "--stamp-offset-ms", type=float, default=0.0, metavar="MS", help="upper exposure later than its stamp says"
    )
    parser.add_argument(
        "--line-time-us",
        type=float,
        nargs="+",
        default=[0.0],
        metavar="US",
        help="rolling shutter: time from row to row, of both cameras or of lower and upper; a stamp is "
        "that of the first row",
    )
    parser.add_argument("--dim", action="store_true", help="dim images with much noise, whose brightness changes")
    parser.add_argument("--photographs", action="store_true", help="on walls, floor and pictures, of scikit-image")
    disturb = parser.add_mutually_exclusive_group()
    disturb.add_argument(
        "--disturb", nargs="+", choices=DISTURBANCES, default=(), metavar="NAME", help=", ".join(DISTURBANCES)
    )
    disturb.add_argument("--real", action="store_const", const=DISTURBANCES, dest="disturb", help="all of --disturb")
    arguments = parser.parse_args()
    run = build(arguments.name, arguments.seed, arguments.size, arguments.pairs)
    rig = with_real_mirrors(run.rig, arguments.seed, arguments.mirrors) if arguments.mirrors else run.rig
    skew, line = arguments.skew_ms, arguments.line_time_us
    readout = Readout(arguments.speed, (skew[0], skew[-1]), arguments.stamp_offset_ms, (line[0], line[-1]))
    started = time.monotonic()

    def progress(done: int, total: int) -> None:
        left_s = (time.monotonic() - started) / done * (total - done)
        sys.stderr.write(f"\r{arguments.name} {done}/{total} pairs, {left_s:.0f} s left  ")

    sensor = DIM if arguments.dim else run.sensor
    write_log(
        arguments.out,
        rig,
        run.poses,
        with_photographs(run.scene, arguments.seed) if arguments.photographs else run.scene,
        sensor=sensor,
        seed=arguments.seed,
        supersample=arguments.supersample,
        readout=readout,
        disturbances=arguments.disturb,
        progress=progress,
    )
    if any(line):
        write_rig(arguments.out / "rig.toml", replace(rig, times=ShutterTimes(0.0, 1e-6 * line[0])))
    sys.stderr.write("\n")


if __name__ == "__main__":
    main()
