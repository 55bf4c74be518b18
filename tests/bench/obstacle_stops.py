"""Stops before obstacles in a closed loop: `python -m tests.bench.obstacle_stops CASE ... --seeds FIRST LAST`.

An operator holds the stick ahead in a corridor at 0.5 m/s; the collision monitor alone keeps the simulated robot from
what it meets. A contact is one of the robot's true outline, over an edge, too; it is the robot's own where the robot
drove. A stop of the monitor is false where nothing true stands or walks within 1 m of the outline, in the robot's way
or 0.2 m beside it, and no person walks within 2 m. The speed told is the highest within 1 m of what stands ahead; the
obstacle rings there are counted, and those that told the way as unknown. A line for each drive is printed; the
published tables are those of `obstacle_drives`.
"""

from __future__ import annotations

import argparse
import math
import random
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.simulation.cameras import SimulatedCameras
from omnid.simulation.clearance import clearance_m, footprints
from omnid.simulation.lockstep import Drive as Script
from omnid.simulation.lockstep import MakeCameras, Moment, Request, SimulatedRun, simulate
from omnid.simulation.people import Walkers
from omnid.simulation.rendering.surfaces import Scene
from omnid.simulation.rendering.textures import PAINTERS
from omnid.simulation.robot import SimulatedRobot
from omnid.simulation.vehicle import START_NS
from omnid.simulation.world import World
from omnid.simulation.world_file import load_world
from tests.bench.cluttered_room import AT_EDGE, ROOMS, Wanderer, furnished, lowered, room_text
from tests.bench.corridor_worlds import CROSSING, LIKE_FLOOR, POLISHED, SPEED_MPS, like_the_floor, world_text
from tests.bench.fine_robot import BUILDS, USUAL, fine_robot
from tests.bench.floating_boxes import KINDS, with_floating
from tests.bench.furniture import FURNITURE, with_furniture
from tests.bench.real_lenses import OF_CAMERAS, with_real_lenses
from tests.bench.uneven_floors import with_edge, with_ramp
from tests.simulation.disturbances import Disturbance
from tests.simulation.photographs import with_photographs

Array = NDArray[np.float64]
Pose = tuple[float, float, float]  # x, y [m], heading [rad]

SIZE_PX: Final = 512
RATE_HZ: Final = 10.0
TILES: Final = "tiles"
PHOTOGRAPHS: Final = "photographs"  # On walls and boxes, too.
FLOORS: Final = (TILES, "granite", "brick", "plaster", PHOTOGRAPHS)
FALSE_M: Final = 1.0
BESIDE_M: Final = 0.2  # of the robot's outline: what stands there may be its reason to stop
WALKS_M: Final = 2.0  # nearer than this, a person who walks may be the reason to stop
TURN_RADPS, TURN_S = 0.8, 10.0  # of a turn on the spot before a drive, with the time to come to rest
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


@dataclass(frozen=True, slots=True)
class Conditions:
    """The ways in which drives of one case may differ."""

    speed_mps: float = SPEED_MPS  # backwards below 0
    size_px: int = SIZE_PX
    rate_hz: float = RATE_HZ
    build: str = USUAL  # of BUILDS
    floor: str = TILES  # of FLOORS; rooms of CLUTTER have their own where it is TILES
    disturbed: tuple[Disturbance, ...] = ()  # by what lenses and cameras do to its images (real_lenses.py)
    turns_first: bool = False  # once on the spot, by which it learns what is fixed to its cameras

    def __str__(self) -> str:
        """Return all in which these conditions differ from the usual ones."""
        parts = [f"{self.speed_mps:g} m/s"] * (self.speed_mps != SPEED_MPS)
        parts += [f"{self.size_px} px"] * (self.size_px != SIZE_PX) + [f"{self.rate_hz:g} Hz"] * (
            self.rate_hz != RATE_HZ
        )
        parts += [f"floor of {self.floor}"] * (self.floor != TILES) + [f"{self.build} robot"] * (self.build != USUAL)
        if self.disturbed:
            parts += ["all disturbances" if self.disturbed == OF_CAMERAS else " and ".join(self.disturbed)]
        parts += ["after a turn"] * self.turns_first
        return ", ".join(parts)


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


def ahead(moment: Moment, speed_mps: float = SPEED_MPS, turn_s: float = 0.0) -> Iterator[Request]:
    """Arm, turn once on the spot for turn_s, and hold the stick ahead, or back at a negative speed."""
    if moment.odometry is not None and not moment.controller.armed and moment.time_s < 2.0:
        yield "arm"
    if moment.time_s < turn_s:
        yield Setpoint(0.0, heading_rad=min(TURN_RADPS * max(moment.time_s - 1.0, 0.0), math.tau))
    else:
        yield Setpoint(speed_mps, heading_rad=0.0)


def run(
    case: str,
    seed: int,
    conditions: Conditions = Conditions(),
    overrides: Sequence[str] = (),
    *,
    cameras: MakeCameras = SimulatedCameras,
    within: Callable[[Script], Script] = lambda script: script,
) -> Drive:
    """Drive one seed of a case along x; cameras: of another renderer; within: puts the script into another one."""
    build, is_backwards = BUILDS[conditions.build], conditions.speed_mps < 0
    robot, tamper = replace(fine_robot(conditions.size_px, build), rate_hz=conditions.rate_hz), None
    if conditions.disturbed:
        robot, tamper = with_real_lenses(robot, seed, conditions.disturbed)
    limits = [f"controller.{part}.velocity_mps={abs(conditions.speed_mps)}" for part in ("limits", "heading")]
    is_cluttered = case.removeprefix(POLISHED) in ROOMS
    world, edges = world_of(case, seed, conditions.floor)
    if not is_cluttered:
        world = replace(world, start=(0.0, 0.0, math.pi if is_backwards else 0.0))
    turn_s = TURN_S if conditions.turns_first and not is_cluttered else 0.0  # in rooms the operator turns anyway
    world = replace(world, people=tuple(replace(person, start_s=person.start_s + turn_s) for person in world.people))
    # The edge of a room is along x; odom begins with the heading of the start.
    towards_rad = -world.start[2] if case == AT_EDGE else None
    script: Script = partial(ahead, speed_mps=conditions.speed_mps, turn_s=turn_s)
    if is_cluttered:
        script = Wanderer(seed, towards_rad)
    done = simulate(
        world,
        robot,
        within(script),
        seconds=CASES[case] + turn_s,
        seed=seed,
        config=load_config(None, ["places.enabled=false", *limits, *build.settings, *overrides]),
        tamper=tamper,
        cameras=cameras,
    )
    return judged(done, world, robot, edges, backwards=is_backwards, everywhere=is_cluttered)


def world_of(case: str, seed: int, floor: str) -> tuple[World, Array]:
    """Return the world of a case and the edges (N, 2, 2) of its floor."""
    bare, edges = case.removeprefix(POLISHED), np.zeros((0, 2, 2))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.toml"
        text = (room_text if bare in ROOMS else world_text)(case, random.Random(seed))
        if floor in PAINTERS and floor != TILES:
            text = re.sub(r"(?m)^floor = .*\n", "", text).replace("[space]", f'[space]\nfloor = "{floor}"')
        path.write_text(text)
        world = load_world(str(path), seed)
    if floor == PHOTOGRAPHS:
        world = replace(world, standing=with_photographs(Scene(world.standing), seed).rectangles)
    if case.startswith("edge"):
        world, edges = with_edge(world, random.Random(seed).uniform(2.0, 3.0), float(case.split()[1]) / 100)
    if case == "ramp":
        world = with_ramp(world, random.Random(seed).uniform(2.0, 3.0))
    if bare in KINDS:
        world = with_floating(world, bare, random.Random(seed))
    if bare in FURNITURE:
        world = with_furniture(world, bare, random.Random(seed))
    if case == LIKE_FLOOR:
        world = like_the_floor(world)
    if case == AT_EDGE:
        world, edges = lowered(world, random.Random(seed))
    return (furnished(world, random.Random(seed)) if bare in ROOMS else world), edges


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
    """Print a line for each run, and the sums of each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+", choices=sorted(CASES), metavar="CASE")
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 3), metavar=("FIRST", "LAST"))
    parser.add_argument("--size", type=int, default=SIZE_PX, metavar="PX", help="of the images")
    parser.add_argument("--speeds", type=float, nargs="+", default=(SPEED_MPS,), help="m/s; below 0: backwards")
    parser.add_argument("--rate", type=float, default=RATE_HZ, metavar="HZ", help="of the cameras")
    parser.add_argument("--robot", choices=BUILDS, default=USUAL, help="its dimensions (fine_robot.py)")
    parser.add_argument("--floor", choices=FLOORS, default=TILES)
    parser.add_argument("--disturb", nargs="+", default=(), choices=OF_CAMERAS, help="its images (real_lenses.py)")
    parser.add_argument("--real", action="store_const", dest="disturb", const=OF_CAMERAS, help="by all of these")
    parser.add_argument("--turn", action="store_true", help="the robot turns once on the spot first")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    usual = Conditions(
        size_px=arguments.size,
        rate_hz=arguments.rate,
        build=arguments.robot,
        floor=arguments.floor,
        disturbed=tuple(arguments.disturb),
        turns_first=arguments.turn,
    )
    seeds = range(arguments.seeds[0], arguments.seeds[1] + 1)
    parts = [(case, replace(usual, speed_mps=speed_mps)) for case in arguments.cases for speed_mps in arguments.speeds]
    with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
        runs = [[pool.submit(run, case, seed, how, arguments.overrides) for seed in seeds] for case, how in parts]
        for (case, how), futures in zip(parts, runs, strict=True):
            drives = []
            for seed, future in zip(seeds, futures, strict=True):
                drives.append(future.result())
                print(f"{case} {seed} {how}: {drives[-1]}", flush=True)
            print(f"{case} {how}: {summed(drives)}", flush=True)


def summed(drives: Sequence[Drive]) -> Drive:
    """Return the sums of drives, their least clearance and highest speed; without reasons."""
    return Drive(
        sum(drive.contacts for drive in drives),
        sum(drive.own for drive in drives),
        min(drive.clearance_m for drive in drives),
        sum(drive.stops for drive in drives),
        sum(drive.false_stops for drive in drives),
        sum(drive.driven_m for drive in drives),
        max(drive.near_mps for drive in drives),
        (sum(drive.unknown[0] for drive in drives), sum(drive.unknown[1] for drive in drives)),
        "",
    )


if __name__ == "__main__":
    main()
