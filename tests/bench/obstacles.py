"""Drives in worlds like buildings: `python -m tests.bench.obstacles [--only NAME ...] [--seeds 1 2] [--speed 0.3 0.5]`.

Two tables follow from the same command. The first: how far the robot drove where nothing was in the way. The second:
what it touched where something was, and whether it stopped 0.05 to 0.8 m before that, or passed. A drive is asked to go
straight on, to turn towards the hazard (--turning), or to a goal; it ends there, where it has stood for a while, or
where the navigation gives up.
Each is a line of build/results/obstacles.jsonl; the command goes on where it ended as long as the commit is the same.

With --open-loop FOLDER, pairs along the way are kept there with the truth, made by a base that nothing stops, and what
the scan and the grid say is compared with it (tests/bench/open_loop.py).
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.core.navigation.requests import GoalRequest, NavigationFrame
from omnid.simulation.rendering.surfaces import Scene
from omnid.simulation.robot import SimulatedRobot
from omnid.simulation.world import Walkers, clearance_m
from tests.bench.results import ROOT, ResultTable, columns, commit
from tests.simulation.disturbed import least_clearance_m, simulate
from tests.simulation.harmless_worlds import FLOORS, Trial
from tests.simulation.hazard_worlds import HARMLESS, HAZARDS, trial
from tests.simulation.lockstep import Moment, Request, SimulatedRun
from tests.simulation.photographs import with_photographs

Array = NDArray[np.float64]

LINES: Final = ROOT / "build" / "results" / "obstacles.jsonl"
FAMILY: Final = "buildings"  # in seeds.toml
OWN_MPS: Final = 0.05  # A contact at a lower speed is not the robot's own.
DRIVEN: Final = 0.95  # share of what was asked that counts as all
STOPS_M: Final = (0.05, 0.8)  # before a hazard
STANDS_M, STANDS_S, HAZARD_STANDS_S = 0.03, 12.0, 8.0  # a drive ends that moved by less than this in that time
TURN_RADIUS_M, TURN_M = 4.0, 2.4  # of the arc towards a hazard, which ends there
TEXTURED: Final = "marbled"  # the floor whose time is the measure of the others
SLOWEST_MPS: Final = 0.1  # A drive that is slower than this on average ends unfinished.


@dataclass(frozen=True, slots=True)
class Planned:
    """A drive that is to be made; its text names it in LINES."""

    world: str
    seed: int
    speed_mps: float = 0.3
    size_px: int = 512
    floor: str | None = None
    is_turning: bool = False
    has_photographs: bool = False  # of floors, walls and pictures
    overrides: tuple[str, ...] = ()  # of settings

    def __str__(self) -> str:
        parts = [f"{self.world} seed {self.seed}, {self.speed_mps:g} m/s, {self.size_px} px"]
        parts += [f"on {self.floor}"] * (self.floor is not None) + ["turning"] * self.is_turning
        parts += ["photographs"] * self.has_photographs + list(self.overrides)
        return ", ".join(parts)


@dataclass(frozen=True, slots=True)
class Drive:
    """What came of a drive."""

    asked_m: float
    driven_m: float  # towards what was asked
    time_s: float  # from the first command to the last motion
    contacts: int
    own: int  # of them, while the robot drove
    clearance_m: float  # least
    stopped_m: float | None  # from the hazard at the end; None: there is none, or it was passed
    ended: str  # where it did not get there, why the wheels stopped last, in the daemon's words

    @property
    def share(self) -> float:
        """Share of what was asked that was driven."""
        return min(1.0, max(0.0, self.driven_m / self.asked_m))

    @property
    def is_right(self) -> bool:
        """True if a hazard was not touched by the robot's own motion, and it passed or stopped at its distance."""
        return not self.own and (self.stopped_m is None or STOPS_M[0] <= self.stopped_m <= STOPS_M[1])


def ahead(moment: Moment) -> Iterator[Request]:
    """Arm, and hold the stick ahead."""
    if moment.odometry is not None and not moment.controller.armed and moment.time_s < 2.0:
        yield "arm"
    yield Setpoint(0.5, heading_rad=0.0)


class Asker:
    """Arms, then asks for the way or for the goal; ends the drive there, or where the base stands."""

    def __init__(self, asked: Trial, planned: Planned) -> None:
        self._asked, self._stands_s = asked, STANDS_S if asked.objects is None else HAZARD_STANDS_S
        speed_mps = -planned.speed_mps if asked.motion == "back" else planned.speed_mps
        self._setpoint = Setpoint(speed_mps, heading_rad=0.0)
        if planned.is_turning:
            self._setpoint = Setpoint(speed_mps, yaw_rate_radps=abs(speed_mps) / TURN_RADIUS_M)
        if asked.motion == "turn left":
            self._setpoint = Setpoint(0.5 * speed_mps, yaw_rate_radps=speed_mps / 0.3)
        self._start: Array | None = None
        self._stood: tuple[float, Array] = (0.0, np.zeros(2))
        self._sent_s = self.began_s = math.inf

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Yield the requests at a moment."""
        place = moment.T_world_base[:2, 3]
        if moment.odometry is None or (not moment.controller.armed and self._start is None):
            if moment.odometry is not None and moment.time_s < 2.0:
                yield "arm"
            return
        if self._start is None:
            self._start, self.began_s, self._stood = place.copy(), moment.time_s, (moment.time_s, place.copy())
        if np.linalg.norm(place - self._stood[1]) > STANDS_M:
            self._stood = moment.time_s, place.copy()
        if self._asked.goal is None:
            yield self._setpoint
            stands = moment.time_s - self._stood[0] > self._stands_s
            if stands or np.linalg.norm(place - self._start) >= self._asked.way_m:
                yield "end"
        elif math.isinf(self._sent_s):
            self._sent_s = moment.time_s
            yield GoalRequest(NavigationFrame.ODOM, *self._asked.goal)
        elif moment.time_s > self._sent_s + 1.0 and moment.navigation is not None and moment.navigation.state.is_end:
            yield "end"


def prepared(planned: Planned) -> tuple[Trial, SimulatedRobot]:
    """Return the trial, with the start that the drive needs, and the robot."""
    asked = trial(planned.world, planned.seed, planned.floor)
    robot = asked.robot(planned.size_px)
    if planned.has_photographs:
        standing = with_photographs(Scene(asked.world.standing), planned.seed)
        asked = replace(asked, world=replace(asked.world, standing=standing))
    x_m, y_m, heading_rad = asked.world.start
    if asked.motion == "ahead" and asked.goal is None:
        if planned.is_turning:  # an arc to the left, at whose end the base looks along x
            angle_rad = math.copysign(TURN_M / TURN_RADIUS_M, planned.speed_mps)
            y_m, heading_rad = math.copysign(TURN_RADIUS_M * (1 - math.cos(angle_rad)), angle_rad), -angle_rad
        if planned.speed_mps < 0:
            heading_rad += math.pi
    return replace(asked, world=replace(asked.world, start=(x_m, y_m, heading_rad))), robot


def settings_for(planned: Planned) -> list[str]:
    """Return the settings of a drive."""
    names = ("controller.limits.velocity_mps", "navigation.pursuit.velocity_mps")
    settings = [f"{name}={abs(planned.speed_mps)}" for name in names]
    return ["places.enabled=false", *settings, *planned.overrides]


def drive(planned: Planned) -> Drive:
    """Make a drive."""
    asked, robot = prepared(planned)
    asked_m = asked.way_m if asked.goal is None else math.hypot(*asked.goal[:2])
    asker = Asker(asked, planned)
    seconds = 5.0 + asked_m / min(SLOWEST_MPS, abs(planned.speed_mps))
    config = load_config(None, settings_for(planned))
    run = simulate(asked.world, robot, asker, seconds=seconds, seed=planned.seed, config=config)
    began_s = 0.0 if math.isinf(asker.began_s) else asker.began_s
    return judged(run, asked, robot, asked_m, began_s)


def judged(run: SimulatedRun, asked: Trial, robot: SimulatedRobot, asked_m: float, began_s: float) -> Drive:
    """Return what came of a run, by the truth."""
    places, times_s = np.array([tick.pose[:2] for tick in run.ticks]), np.array([tick.time_s for tick in run.ticks])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times_s)
    # 1. How far it came.
    driven_m = float(np.linalg.norm(places[-1] - places[0]))
    if asked.goal is not None:
        c, s = math.cos(asked.world.start[2]), math.sin(asked.world.start[2])
        x_m, y_m, _ = asked.goal
        goal = places[0] + (c * x_m - s * y_m, s * x_m + c * y_m)
        driven_m = asked_m - float(np.linalg.norm(places[-1] - goal))
    moved = np.flatnonzero(speeds > OWN_MPS)
    last_s = times_s[moved[-1] + 1] if len(moved) else began_s
    # 2. What it touched, and where it stood.
    at_contact = [int(np.argmin(np.abs(times_s[1:] - tick.time_s))) for tick in run.contacts]
    own = sum(bool(speeds[tick] > OWN_MPS) for tick in at_contact)
    is_through = driven_m >= DRIVEN * asked_m
    stopped_m = None
    if asked.objects is not None and asked.motion == "ahead" and not is_through:
        stopped_m = _from_hazard_m(run, asked, robot)
    # 3. Why, in the daemon's words.
    stops = [line.removeprefix("the wheels stop: ") for _, line in run.lines if line.startswith("the wheels stop")]
    disarmed = [line for at_s, line in run.lines if line.startswith("disarmed") and at_s < run.ticks[-1].time_s - 2.5]
    states = [f"{update.state}: {update.reason}" for update in run.navigation if update.reason]
    ended = "" if is_through else "; ".join([*states[-1:], *(disarmed or stops)[-1:]])
    time_s = float(last_s - began_s)
    return Drive(asked_m, driven_m, time_s, len(run.contacts), own, least_clearance_m(run), stopped_m, ended)


def _from_hazard_m(run: SimulatedRun, asked: Trial, robot: SimulatedRobot) -> float:
    """Return the distance of the outline from what is in the way, at the end."""
    people = Walkers(asked.world.people)
    for tick in run.ticks:
        people.advance(tick.time_s, tick.pose[:2])
    objects = (*(asked.objects or ()), *people.faces())
    segments = np.concatenate([asked.world.footprints(objects, robot.height_m), asked.world.edges])
    if asked.world.name == "steep_ramp":  # it begins there
        x_m = asked.world.ground.profile[0][0]
        segments = np.array([[[x_m, -1.2], [x_m, 1.2]]])
    return clearance_m(segments, run.ticks[-1].pose[:2], robot.radius_m)


# Results


def known_drives() -> dict[str, Drive]:
    """Return the drives of this commit that LINES has, by name."""
    lines = (json.loads(line) for line in LINES.read_text().splitlines()) if LINES.exists() else ()
    here = commit()
    return {line["name"]: Drive(**line["drive"]) for line in lines if line["commit"] == here}


Made = Sequence[tuple[Planned, Drive]]


def groups(made: Made) -> Iterator[tuple[str, Made]]:
    """Yield the rows of a table: by world, then by speed, size and floor where there are several, then all."""
    keys: tuple[Callable[[Planned], str], ...] = (
        lambda one: one.world,
        lambda one: f"at {one.speed_mps:g} m/s" + " turning" * one.is_turning,
        lambda one: f"{one.size_px} px",
        lambda one: f"on {one.floor or 'its own floor'}",
    )
    for number, key in enumerate(keys):
        names = list(dict.fromkeys(key(planned) for planned, _ in made))
        if number == 0 or len(names) > 1:
            yield from ((name, [one for one in made if key(one[0]) == name]) for name in names)
    yield "all", made


def pace(planned: Planned, made: Made) -> float:
    """Return the time [s] of a metre on a textured floor at this speed and size; that of steady speed without one."""
    times = [
        drive.time_s / drive.driven_m
        for one, drive in made
        if one.world == TEXTURED and (one.speed_mps, one.size_px) == (planned.speed_mps, planned.size_px)
    ]
    return float(np.median(times)) if times else 1.0 / abs(planned.speed_mps)


def add_free_table(made: Made) -> None:
    """Print and write the table of the worlds in which nothing is in the way."""
    head = columns(
        *("world", "drives", "driven of what was asked|%|0", "time to that of a textured floor||2"),
        *("all of it, in 1.5 times that time|%|0", "contacts", "last stop"),
    )
    table = ResultTable("obstacles_free", "Where nothing is in the way", head)
    table.seeds = sorted({(FAMILY, planned.seed) for planned, _ in made})
    for name, part in groups(made):
        ratios = [d.time_s / max(d.driven_m, 0.1) / pace(one, made) for one, d in part]
        good = [d.share >= DRIVEN and ratio <= 1.5 for (_, d), ratio in zip(part, ratios, strict=True)]
        share = 100 * float(np.mean([d.share for _, d in part]))
        reasons = "; ".join(dict.fromkeys(d.ended for _, d in part if d.ended)) if name in HARMLESS else ""
        contacts = sum(d.own for _, d in part)
        table.add(name, len(part), share, float(np.median(ratios)), 100 * float(np.mean(good)), contacts, reasons)


def add_hazard_table(made: Made) -> None:
    """Print and write the table of the worlds in which something is in the way."""
    head = columns(
        *("hazard", "drives", "contacts", "of the robot's own", "least clearance|m|2"),
        *("passed, or stopped 0.05 to 0.8 m before it|%|0", "stopped earlier", "distances of the stops|m", "last stop"),
    )
    table = ResultTable("obstacles_touched", "What was touched", head)
    table.seeds = sorted({(FAMILY, planned.seed) for planned, _ in made})
    for name, part in groups(made):
        drives = [d for _, d in part]
        stops = sorted(d.stopped_m for d in drives if d.stopped_m is not None)
        is_one = len({one.world for one, _ in part}) == 1
        table.add(
            name,
            len(drives),
            sum(d.contacts for d in drives),
            sum(d.own for d in drives),
            min(d.clearance_m for d in drives),
            100 * float(np.mean([d.is_right for d in drives])),
            sum(stop_m > STOPS_M[1] for stop_m in stops),
            " ".join(f"{stop_m:.2f}" for stop_m in stops) if is_one else "",
            "; ".join(dict.fromkeys(d.ended for d in drives if d.ended))[:200] if is_one else "",
        )


def tables(wanted: Sequence[Planned], drives: dict[str, Drive]) -> None:
    """Print and write both tables of the drives that were made."""
    made = [(one, drives[str(one)]) for one in wanted if str(one) in drives]
    for add, is_hazard in ((add_free_table, False), (add_hazard_table, True)):
        part = [(one, d) for one, d in made if (one.world not in HARMLESS) == is_hazard]
        if part:
            add(part)


def main() -> None:
    """Make the drives that are missing, print a line for each, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="worlds; harmless, hazards: all of them; default both"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--speed", type=float, nargs="+", default=[0.3], help="m/s; below 0: backwards")
    parser.add_argument("--px", type=int, nargs="+", default=[512], help="sizes of the images")
    parser.add_argument("--floor", nargs="+", choices=FLOORS, default=[None], help="other floors than the worlds' own")
    parser.add_argument("--turning", action="store_true", help="towards hazards on an arc")
    parser.add_argument("--photographs", action="store_true", help="on floors, walls and pictures (scikit-image's)")
    parser.add_argument("--open-loop", type=Path, metavar="FOLDER", help="keep pairs there, and judge the scan")
    parser.add_argument("--jobs", type=int, default=1, help="drives at a time")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    lists = {"harmless": HARMLESS, "hazards": HAZARDS}
    names = [name for given in arguments.only or lists for name in lists.get(given, (given,))]
    overrides = tuple(arguments.overrides)
    wanted = [
        Planned(name, seed, speed_mps, size_px, floor, arguments.turning, arguments.photographs, overrides)
        for name, speed_mps, size_px, floor, seed in product(
            names, arguments.speed, arguments.px, arguments.floor, arguments.seeds
        )
    ]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes that follow
    if arguments.open_loop:
        from tests.bench.open_loop import judge_scans

        judge_scans(wanted, arguments.open_loop, arguments.jobs)
        return
    here, drives = commit(), known_drives()
    missing = [planned for planned in wanted if str(planned) not in drives]
    LINES.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool, LINES.open("a") as lines:
        waiting = {pool.submit(drive, planned): planned for planned in missing}
        for future in as_completed(waiting):
            name, made = str(waiting[future]), future.result()
            drives[name] = made
            print(f"{name}: {made}", flush=True)
            lines.write(json.dumps({"commit": here, "name": name, "drive": asdict(made)}) + "\n")
            lines.flush()
    tables(wanted, drives)


if __name__ == "__main__":
    main()
