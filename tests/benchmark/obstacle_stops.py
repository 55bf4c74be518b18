"""Stops before obstacles in a closed loop: `python -m tests.benchmark.obstacle_stops CASE --seeds FIRST LAST`.

An operator holds the stick ahead in a corridor at 0.5 m/s; the collision monitor alone keeps the simulated robot from
what it meets. A contact is one of the robot's true outline; a stop is false where nothing true stands within 1 m ahead.
"""

from __future__ import annotations

import argparse
import math
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.simulation.lockstep import Moment, Request, SimulatedRun, simulate
from omnid.simulation.robot import make_robot
from omnid.simulation.world_file import load_world

SPEED_MPS: Final = 0.5
FALSE_M: Final = 1.0
CASES: Final = {"person at 0.8 m": 7.0, "person at 1.5 m": 7.0, "box": 9.0, "white wall": 12.0, "free": 16.0}


class Drive(NamedTuple):
    """Result of a run."""

    contacts: int
    clearance_m: float
    stops: int  # begun by the monitor
    false_stops: int
    driven_m: float
    last_reason: str


def world_text(case: str, rng: random.Random) -> str:
    """Return a corridor along x with what the case says in it, as a world file."""
    left, right, length = rng.uniform(0.9, 1.5), -rng.uniform(0.9, 1.5), 12.0
    walls = [rng.choice(("brick", "granite", "plaster")) for _ in range(2)]
    end = "plain" if case == "white wall" else "brick"
    end_m = rng.uniform(3.5, 4.5) if case == "white wall" else length
    posters = 0.0 if case == "white wall" else 0.6
    lines = ["schema = 1", "start = [0.0, 0.0, 0.0]", "[space]", f"low = [-2.0, {right}]", f"high = [{end_m}, {left}]",
             "[[wall]]", f"points = [[-2.0, {left}], [{end_m}, {left}]]", f'texture = "{walls[0]}"',
             "posters_per_m = 0.6",
             "[[wall]]", f"points = [[{end_m}, {right}], [-2.0, {right}]]", f'texture = "{walls[1]}"',
             "posters_per_m = 0.6",
             "[[wall]]", f"points = [[{end_m}, {left}], [{end_m}, {right}]]", f'texture = "{end}"',
             f"posters_per_m = {posters}",
             "[[wall]]", f"points = [[-2.0, {right}], [-2.0, {left}]]", 'texture = "brick"']
    if case == "box":
        size = [rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.6), rng.uniform(0.4, 1.2)]
        lines += ["[[box]]", f"at = [{rng.uniform(2.0, 3.0)}, {rng.uniform(-0.15, 0.15)}]", f"size_m = {size}",
                  f"yaw_deg = {rng.uniform(-40, 40)}"]
    if case.startswith("person"):
        within_m, side = float(case.split()[2]), rng.choice((1, -1))
        at_m, aside = rng.uniform(2.3, 3.0), side * (min(left, -right) - 0.3)
        lines += ["[[person]]", f"path = [[{at_m}, {aside}], [{at_m}, {rng.uniform(-0.1, 0.1)}]]",
                  f"speed_mps = {rng.uniform(0.8, 1.4)}", f"starts_within_m = {within_m + 0.2 + abs(aside) * 0.4}"]
    return "\n".join(lines) + "\n"


def ahead(moment: Moment) -> Iterator[Request]:
    """Arm, and hold the stick ahead."""
    if moment.odometry is not None and not moment.controller.armed and moment.time_s < 2.0:
        yield "arm"
    yield Setpoint(SPEED_MPS, heading_rad=0.0)


def run(case: str, seed: int, size_px: int, overrides: list[str]) -> Drive:
    """Drive one seed of a case."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.toml"
        path.write_text(world_text(case, random.Random(seed)))
        world = load_world(str(path), seed)
        done = simulate(world, make_robot(size_px), ahead, seconds=CASES[case], seed=seed,
                        config=load_config(None, ["places.enabled=false", *overrides]))
    return judged(done)


def judged(done: SimulatedRun) -> Drive:
    """Return the result of a run, from the truth at its ticks."""
    lines = [(at_s, text) for at_s, text in done.lines if "obstacle" in text or "way ahead" in text]
    false = 0
    for at_s, _ in lines:
        tick = min(done.ticks, key=lambda one: abs(one.time_s - at_s))
        false += tick.clearance_m > FALSE_M
    driven_m = math.dist(done.ticks[0].pose[:2], done.ticks[-1].pose[:2])
    return Drive(len(done.contacts), done.clearance_m, len(lines), false, driven_m, lines[-1][1] if lines else "")


def main() -> None:
    """Print a line for each run, and a row of the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", choices=sorted(CASES))
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 3), metavar=("FIRST", "LAST"))
    parser.add_argument("--size", type=int, default=512, help="of the images, px")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    drives = []
    for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
        drive = run(arguments.case, seed, arguments.size, arguments.overrides)
        drives.append(drive)
        print(f"{seed}: contacts {drive.contacts}, clearance {drive.clearance_m:.2f} m, stops {drive.stops}, false "
              f"{drive.false_stops}, driven {drive.driven_m:.2f} m; {drive.last_reason}", flush=True)
    print(f"| {arguments.case} | {len(drives)} | {sum(drive.contacts for drive in drives)} | "
          f"{min(drive.clearance_m for drive in drives):.2f} m | {sum(drive.false_stops for drive in drives)} in "
          f"{sum(drive.driven_m for drive in drives):.1f} m |")


if __name__ == "__main__":
    main()
