"""Stops before obstacles in a closed loop: `python -m tests.benchmark.obstacle_stops CASE ... --seeds FIRST LAST`.

An operator holds the stick ahead in a corridor at 0.5 m/s; the collision monitor alone keeps the simulated robot from
what it meets. A contact is one of the robot's true outline, over an edge, too; it is the robot's own where the robot
drove. A stop of the monitor is false where nothing true stands or walks within 1 m of the outline, in the robot's way
or 0.2 m beside it, and no person walks within 2 m. The speed told is the highest within 1 m of what stands ahead; the
obstacle rings there are counted, and those that told the way as unknown.
"""

from __future__ import annotations

import argparse
import itertools
import math
import random
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.simulation.clearance import clearance_m, footprints
from omnid.simulation.lockstep import Moment, Request, SimulatedRun, simulate
from omnid.simulation.people import Walkers
from omnid.simulation.robot import SimulatedRobot
from omnid.simulation.vehicle import START_NS
from omnid.simulation.world import World
from omnid.simulation.world_file import load_world
from tests.benchmark.cluttered_room import AT_EDGE, ROOMS, Wanderer, furnished, lowered, room_text
from tests.benchmark.corridor_worlds import CROSSING, LIKE_FLOOR, POLISHED, SPEED_MPS, like_the_floor, world_text
from tests.benchmark.fine_robot import BUILDS, USUAL, fine_robot
from tests.benchmark.floating_boxes import KINDS, with_floating
from tests.benchmark.furniture import FURNITURE, with_furniture
from tests.benchmark.real_lenses import OF_CAMERAS, with_real_lenses
from tests.benchmark.results import Column, ResultTable
from tests.benchmark.uneven_floors import with_edge, with_ramp
from tests.simulation.disturbances import Disturbance

Array = NDArray[np.float64]
Pose = tuple[float, float, float]  # x, y [m], heading [rad]

SIZE_PX: Final = 512
RATE_HZ: Final = 10.0
REMARKS: Final = (
    "A simulated robot at 0.5 m/s by the stick, straight on, 512 px at 10 Hz where a row says nothing else; only the "
    "collision monitor keeps it from what it meets. A stop is false where the truth has nothing within 1 m ahead, or "
    "up to 0.2 m to the side of the way. A contact counts for an edge when the outline is over it; of a person who "
    "crosses, either of the two may have moved.",
)
FALSE_M: Final = 1.0
BESIDE_M: Final = 0.2  # of the robot's outline: what stands there may be its reason to stop
WALKS_M: Final = 2.0  # nearer than this, a person who walks may be the reason to stop
OWN_MPS: Final = 0.05  # a contact at a lower speed is not the robot's own
AHEAD: Final = slice(170, 190)  # sectors of the ring
CASES: Final = {
    "person at 0.8 m": 12.0,
    "person at 1.5 m": 12.0,
    "box": 12.0,
    "low box": 12.0,
    "plain pole": 12.0,
    "pole": 12.0,
    "white wall": 20.0,
    "free": 24.0,
    "edge 8 cm": 10.0,
    "edge 15 cm": 10.0,
    "edge 30 cm": 10.0,
    "edge 50 cm": 10.0,
    "ramp": 10.0,
} | dict.fromkeys((*KINDS, *FURNITURE), 12.0)
CASES |= dict.fromkeys(CROSSING, 9.0)
CASES |= dict.fromkeys(ROOMS, 40.0)  # The operator drives at random.
UNEVEN: Final = ("edge", "ramp", AT_EDGE)  # Cases whose floor has two heights.
CASES |= {POLISHED + case: seconds for case, seconds in CASES.items() if not case.startswith(UNEVEN)}


class Drive(NamedTuple):
    """Result of a run."""

    contacts: int
    own: int  # of them, where the robot drove
    clearance_m: float
    stops: int  # begun by the monitor
    false_stops: int
    driven_m: float
    near_mps: float  # highest speed within FALSE_M of what stands ahead
    unknown: tuple[int, int]  # rings that told it as unknown, of those within FALSE_M of it
    reasons: str


def ahead(moment: Moment, speed_mps: float = SPEED_MPS) -> Iterator[Request]:
    """Arm, and hold the stick ahead, or back at a negative speed."""
    if moment.odometry is not None and not moment.controller.armed and moment.time_s < 2.0:
        yield "arm"
    yield Setpoint(speed_mps, heading_rad=0.0)


def run(
    case: str,
    seed: int,
    size_px: int,
    overrides: list[str],
    speed_mps: float = SPEED_MPS,
    rate_hz: float = RATE_HZ,
    build: str = USUAL,
    disturbed: Sequence[Disturbance] = (),
) -> Drive:
    """Drive one seed of a case along x, backwards at a negative speed, with a robot of BUILDS.

    disturbed: by what lenses and cameras do to its images (real_lenses.py).
    """
    robot, tamper = replace(fine_robot(size_px, BUILDS[build]), rate_hz=rate_hz), None
    if disturbed:
        robot, tamper = with_real_lenses(robot, seed, disturbed)
    limits = [f"controller.{part}.velocity_mps={abs(speed_mps)}" for part in ("limits", "heading")]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.toml"
        is_cluttered = case.removeprefix(POLISHED) in ROOMS
        path.write_text((room_text if is_cluttered else world_text)(case, random.Random(seed)))
        world = load_world(str(path), seed)
        edges = np.zeros((0, 2, 2))
        if case.startswith("edge"):
            world, edges = with_edge(world, random.Random(seed).uniform(2.0, 3.0), float(case.split()[1]) / 100)
        if case == "ramp":
            world = with_ramp(world, random.Random(seed).uniform(2.0, 3.0))
        if case.removeprefix(POLISHED) in KINDS:
            world = with_floating(world, case.removeprefix(POLISHED), random.Random(seed))
        if case.removeprefix(POLISHED) in FURNITURE:
            world = with_furniture(world, case.removeprefix(POLISHED), random.Random(seed))
        if case == LIKE_FLOOR:
            world = like_the_floor(world)
        towards_rad = None
        if case == AT_EDGE:
            world, edges = lowered(world, random.Random(seed))
            towards_rad = -world.start[2]  # The edge is along x; odom begins with the heading of the start.
        if is_cluttered:
            world = furnished(world, random.Random(seed))
        else:
            world = replace(world, start=(0.0, 0.0, math.pi if speed_mps < 0 else 0.0))
        done = simulate(
            world,
            robot,
            Wanderer(seed, towards_rad) if is_cluttered else partial(ahead, speed_mps=speed_mps),
            seconds=CASES[case],
            seed=seed,
            config=load_config(None, ["places.enabled=false", *limits, *BUILDS[build].settings, *overrides]),
            tamper=tamper,
        )
    return judged(done, world, robot, edges, backwards=speed_mps < 0, everywhere=is_cluttered)


def judged(
    done: SimulatedRun,
    world: World,
    robot: SimulatedRobot,
    edges: Array,
    *,
    backwards: bool = False,
    everywhere: bool = False,
) -> Drive:
    """Return the result of a run, from the truth at its ticks; edges (N, 2, 2): where the floor falls.

    everywhere: what stands in any direction may be the reason of a stop, and not only what stands ahead.
    """
    turn_rad = math.pi if backwards else 0.0
    standing, people = np.concatenate([footprints(world.standing, robot.height_m), edges]), Walkers(world.people)
    to_edge_m = [clearance_m(edges, tick.pose[:2], robot.radius_m) for tick in done.ticks]
    over = int(min(to_edge_m) <= 0.0)
    ahead_m, walks, places = [], [], people.places()
    for tick in done.ticks:
        people.advance(tick.time_s, tick.pose[:2])
        before, places = places, people.places()
        walks.append(_walks(before, places, tick.pose))
        segments = np.concatenate([standing, footprints(people.faces(), robot.height_m)])
        x_m, y_m, heading_rad = tick.pose
        ahead_m.append(
            clearance_m(segments, (x_m, y_m), robot.radius_m)
            if everywhere
            else room_ahead_m(segments, (x_m, y_m, heading_rad + turn_rad), robot.radius_m)
        )
    lines = [(at_s, text) for at_s, text in done.lines if "obstacle" in text or "way ahead" in text]
    times = np.array([tick.time_s for tick in done.ticks])
    begun = [int(np.argmin(np.abs(times - at_s))) for at_s, _ in lines]
    false = sum(ahead_m[tick] > FALSE_M and not walks[tick] for tick in begun)
    steps_m = np.linalg.norm(np.diff([tick.pose[:2] for tick in done.ticks], axis=0), axis=1)
    speeds = steps_m / np.diff(times)
    near_mps = speeds[np.array(ahead_m)[1:] <= FALSE_M].max(initial=0.0)
    rings = [
        ring
        for ring in done.rings
        if ahead_m[int(np.argmin(np.abs(times - (ring.stamp_ns - START_NS) * 1e-9)))] <= FALSE_M
    ]
    unknown = sum(
        bool(np.isnan(np.roll(ring.ranges_m, len(ring.ranges_m) // 2 * backwards)[AHEAD]).mean() > 0.5)
        for ring in rings
    )
    reasons = "; ".join(
        f"{at_s:.1f} s {text.removeprefix('the wheels stop: ').partition(';')[0]}" for at_s, text in lines
    )
    at_contact = [int(np.argmin(np.abs(times[1:] - tick.time_s))) for tick in done.contacts]
    return Drive(
        len(done.contacts) + over,
        sum(bool(speeds[tick] > OWN_MPS) for tick in at_contact) + over,
        min(done.clearance_m, *to_edge_m),
        len(lines),
        false,
        float(steps_m.sum()),
        float(near_mps),
        (unknown, len(rings)),
        reasons,
    )


def _walks(before: Sequence[Pose], now: Sequence[Pose], robot: Pose) -> bool:
    """Return whether somebody walks near the robot, by people's places before and now."""
    pairs = zip(before, now, strict=True)
    return any(then != place and math.dist(place[:2], robot[:2]) < WALKS_M for then, place in pairs)


def room_ahead_m(segments: Array, pose: Pose, radius_m: float) -> float:
    """Return the way [m] from a disc to the nearest of segments (N, 2, 2) that stands ahead or a little beside it."""
    x_m, y_m, heading_rad = pose
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    local = (segments - (x_m, y_m)) @ np.array([[c, -s], [s, c]])
    steps = np.linspace(0.0, 1.0, 60)[:, None, None]
    points = (local[:, 0] + steps * (local[:, 1] - local[:, 0])).reshape(-1, 2)
    is_ahead = (points[:, 0] > 0) & (np.abs(points[:, 1]) < radius_m + BESIDE_M)
    return float(points[is_ahead, 0].min(initial=math.inf)) - radius_m


def main() -> None:
    """Print a line for each run, and a row for each case at a speed and a size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+", choices=sorted(CASES), metavar="CASE")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 3), metavar=("FIRST", "LAST"))
    parser.add_argument("--sizes", type=int, nargs="+", default=(512,), help="of the images, px")
    parser.add_argument("--speeds", type=float, nargs="+", default=(SPEED_MPS,), help="m/s; below 0: backwards")
    parser.add_argument("--rate", type=float, default=RATE_HZ, metavar="HZ", help="of the cameras")
    parser.add_argument("--robot", choices=BUILDS, default=USUAL, help="its dimensions (fine_robot.py)")
    parser.add_argument("--disturb", nargs="+", default=(), choices=OF_CAMERAS, help="its images (real_lenses.py)")
    parser.add_argument("--real", action="store_const", dest="disturb", const=OF_CAMERAS, help="by all of these")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    table = ResultTable(
        "obstacle_stops",
        "obstacles",
        "Stops of the collision monitor",
        (
            Column("case"),
            Column("drives"),
            Column("contacts"),
            Column("of the robot's own"),
            Column("least clearance", "m", 2),
            Column("stops"),
            Column("false stops"),
            Column("driven", "m", 1),
            Column("highest speed within 1 m", "m/s", 2),
            Column("unknown rings within 1 m"),
            Column("rings within 1 m"),
        ),
        REMARKS,
        continued=True,
    )
    seeds = range(arguments.seeds[0], arguments.seeds[1] + 1)
    table.seeds = [("obstacle stops", seed) for seed in seeds]
    parts = list(itertools.product(arguments.cases, arguments.speeds, arguments.sizes))
    built = partial(run, rate_hz=arguments.rate, build=arguments.robot, disturbed=arguments.disturb)
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        runs = [
            [pool.submit(built, case, seed, size_px, arguments.overrides, speed_mps) for seed in seeds]
            for case, speed_mps, size_px in parts
        ]
        for part, futures in zip(parts, runs, strict=True):
            drives = []
            for seed, future in zip(seeds, futures, strict=True):
                drives.append(future.result())
                print(f"{part[0]} {seed}: {drives[-1]}", flush=True)
            _add(table, _named(*part, arguments), drives)


def _named(case: str, speed_mps: float, size_px: int, arguments: argparse.Namespace) -> str:
    """Return a case with all in which its drives differ from the usual ones."""
    at = f", {speed_mps:g} m/s" * (speed_mps != SPEED_MPS) + f", {size_px} px" * (size_px != SIZE_PX)
    at += f", {arguments.rate:g} Hz" * (arguments.rate != RATE_HZ)
    if arguments.disturb:
        at += ", all disturbances" if arguments.disturb == OF_CAMERAS else f", {' and '.join(arguments.disturb)}"
    return case + at + f", {arguments.robot} robot" * (arguments.robot != USUAL)


def _add(table: ResultTable, label: str, drives: Sequence[Drive]) -> None:
    table.add(
        label,
        len(drives),
        sum(drive.contacts for drive in drives),
        sum(drive.own for drive in drives),
        min(drive.clearance_m for drive in drives),
        sum(drive.stops for drive in drives),
        sum(drive.false_stops for drive in drives),
        sum(drive.driven_m for drive in drives),
        max(drive.near_mps for drive in drives),
        *(sum(drive.unknown[k] for drive in drives) for k in (0, 1)),
    )


if __name__ == "__main__":
    main()
