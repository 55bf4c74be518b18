"""Drives in worlds like buildings: `python -m tests.bench.obstacles [--only NAME ...] [--seeds 1 2] [--speed 0.3 0.5]`.

Two tables follow from the same drives: how far the robot drove where nothing was in the way, and what it touched where
something was. A drive is asked to go straight on, or to a goal; it ends when it is there, or when it could have been
there at SLOWEST_MPS. Each is a line of build/results/obstacles.jsonl; the command goes on where it ended as long as the
commit is the same.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from typing import Final

import numpy as np

from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.requests import GoalRequest, NavigationFrame
from omnid.simulation.lockstep import Moment, Request, SimulatedRun, simulate
from omnid.simulation.named_worlds import HARMLESS, SLOWEST_MPS, Trial, trial
from tests.bench.results import ROOT, Column, ResultTable, commit

LINES: Final = ROOT / "build" / "results" / "obstacles.jsonl"
FAMILY: Final = "buildings"  # in seeds.toml
OWN_MPS: Final = 0.05  # A contact at a lower speed is not the robot's own.
DRIVEN: Final = 0.95  # share of what was asked that counts as all


@dataclass(frozen=True, slots=True)
class Planned:
    """A drive that is to be made; its text names it in LINES."""

    world: str
    seed: int
    speed_mps: float = 0.3
    size_px: int = 512

    def __str__(self) -> str:
        return f"{self.world} seed {self.seed}, {self.speed_mps:g} m/s, {self.size_px} px"


@dataclass(frozen=True, slots=True)
class Drive:
    """What came of a drive."""

    asked_m: float
    driven_m: float  # towards what was asked
    time_s: float  # from the first command to the end, or to the last motion
    contacts: int
    own: int  # of them, while the robot drove
    clearance_m: float  # least
    ended: str  # where it did not get there, why the wheels stopped last, in the daemon's words
    cpu_s: float

    @property
    def share(self) -> float:
        """Share of what was asked that was driven."""
        return min(1.0, self.driven_m / self.asked_m)


class Asker:
    """Arms, then asks for the way straight on or for the goal; ends the drive there."""

    def __init__(self, asked: Trial, speed_mps: float) -> None:
        self._asked, self._speed_mps = asked, speed_mps
        self._start: tuple[float, float] | None = None
        self._sent_s = math.inf
        self.began_s = math.inf

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Yield the requests at a moment."""
        if moment.odometry is None:
            return
        if not moment.controller.armed:
            if moment.time_s < 2.0:
                yield "arm"
            return
        place = moment.T_world_base[:2, 3]
        if self._start is None:
            self._start, self.began_s = (float(place[0]), float(place[1])), moment.time_s
        if self._asked.goal is None:
            yield Setpoint(self._speed_mps, heading_rad=0.0)
            if math.dist(self._start, place) >= self._asked.way_m:
                yield "end"
        elif math.isinf(self._sent_s):
            self._sent_s = moment.time_s
            yield GoalRequest(NavigationFrame.ODOM, *self._asked.goal)
        elif moment.time_s > self._sent_s + 1.0 and moment.navigation is not None and moment.navigation.state.is_end:
            yield "end"


def drive(planned: Planned, overrides: Sequence[str] = ()) -> Drive:
    """Make a drive."""
    asked, cpu_s = trial(planned.world, planned.seed), time.process_time()
    robot = asked.robot(planned.size_px)
    names = ("controller.limits.velocity_mps", "controller.heading.velocity_mps", "navigation.velocity_mps")
    settings = [f"{name}={abs(planned.speed_mps)}" for name in names]
    config = load_config(None, ["places.enabled=false", *settings, *overrides])
    script = Asker(asked, planned.speed_mps)
    asked_m = asked.way_m if asked.goal is None else math.hypot(*asked.goal[:2])
    seconds = 5.0 + asked_m / min(SLOWEST_MPS, abs(planned.speed_mps))
    run = simulate(asked.world, robot, script, seconds=seconds, seed=planned.seed, config=config)
    return judged(run, asked, asked_m, script.began_s, time.process_time() - cpu_s)


def judged(run: SimulatedRun, asked: Trial, asked_m: float, began_s: float, cpu_s: float) -> Drive:
    """Return what came of a run, by the truth."""
    places = np.array([tick.pose[:2] for tick in run.ticks])
    times_s = np.array([tick.time_s for tick in run.ticks])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times_s)
    driven_m = float(np.linalg.norm(places[-1] - places[0]))
    if asked.goal is not None:
        c, s = math.cos(asked.world.start[2]), math.sin(asked.world.start[2])
        x_m, y_m, _ = asked.goal
        goal = places[0] + (c * x_m - s * y_m, s * x_m + c * y_m)
        driven_m = asked_m - float(np.linalg.norm(places[-1] - goal))
    moved = np.flatnonzero(speeds > OWN_MPS)
    last_s = times_s[moved[-1] + 1] if len(moved) else began_s
    at_contact = [int(np.argmin(np.abs(times_s[1:] - tick.time_s))) for tick in run.contacts]
    stops = [line.removeprefix("the wheels stop: ") for _, line in run.lines if line.startswith("the wheels stop")]
    states = [f"{update.state}: {update.reason}" for update in run.navigation if update.reason]
    ended = "" if driven_m >= DRIVEN * asked_m else "; ".join([*states[-1:], *stops[-1:]])
    own = sum(bool(speeds[tick] > OWN_MPS) for tick in at_contact)
    return Drive(asked_m, driven_m, float(last_s - began_s), len(run.contacts), own, run.clearance_m, ended, cpu_s)


def known_drives() -> dict[str, Drive]:
    """Return the drives of this commit that LINES has, by name."""
    lines = (json.loads(line) for line in LINES.read_text().splitlines()) if LINES.exists() else ()
    here = commit()
    return {line["name"]: Drive(**line["drive"]) for line in lines if line["commit"] == here}


def add_table(planned: Sequence[Planned], drives: dict[str, Drive]) -> None:
    """Print and write the table of the harmless worlds."""
    columns = (
        Column("world"),
        Column("drives"),
        Column("driven of what was asked", "%", 0),
        Column("time to that of steady speed", "", 2),
        Column("contacts"),
        Column("last stop"),
    )
    table = ResultTable("obstacles_free", "Where nothing is in the way", columns)
    table.seeds = sorted({(FAMILY, one.seed) for one in planned})
    for name in dict.fromkeys(one.world for one in planned):
        made = [(one, drives[str(one)]) for one in planned if one.world == name and str(one) in drives]
        if made:
            ratios = [d.time_s * abs(one.speed_mps) / max(d.driven_m, 0.1) for one, d in made]
            share = 100 * float(np.mean([d.share for _, d in made]))
            reasons = "; ".join(dict.fromkeys(d.ended for _, d in made if d.ended))
            table.add(name, len(made), share, float(np.median(ratios)), sum(d.own for _, d in made), reasons)


def main() -> None:
    """Make the drives that are missing, print a line for each, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=HARMLESS, metavar="NAME", help="worlds (omnid.simulation)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--speed", type=float, nargs="+", default=[0.3], help="m/s; below 0: backwards")
    parser.add_argument("--px", type=int, nargs="+", default=[512], help="sizes of the images")
    parser.add_argument("--jobs", type=int, default=1, help="drives at a time")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    here, drives = commit(), known_drives()
    wanted = [
        Planned(name, seed, speed_mps, size_px)
        for name in arguments.only
        for speed_mps in arguments.speed
        for size_px in arguments.px
        for seed in arguments.seeds
    ]
    missing = [planned for planned in wanted if str(planned) not in drives]
    LINES.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool, LINES.open("a") as lines:
        waiting = {pool.submit(drive, planned, arguments.overrides): planned for planned in missing}
        for future in as_completed(waiting):
            name, made = str(waiting[future]), future.result()
            drives[name] = made
            print(f"{name}: {made}", flush=True)
            lines.write(json.dumps({"commit": here, "name": name, "drive": asdict(made)}) + "\n")
            lines.flush()
    add_table(wanted, drives)


if __name__ == "__main__":
    main()
