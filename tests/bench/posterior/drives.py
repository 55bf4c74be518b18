"""Drives into the room of a case at true poses, and what the obstacle grid says of it, against the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.config import Config
from omnid.core.mapping.range_scan import azimuths
from omnid.core.obstacles.cell_kernels import FLOOR, VISIBLE
from omnid.core.obstacles.column import NEAREST_M, Columns, floor_plane
from omnid.core.obstacles.grid import CELL_M, CELLS, GridRing, ObstacleGrid, level_odds
from omnid.core.obstacles.pair_views import FOCAL_PX
from omnid.core.obstacles.settings import RingSettings
from omnid.messages import FramePair, Panoramas
from omnid.simulation.lockstep import with_masks
from omnid.simulation.rendering.sensor import MountedSensor
from omnid.simulation.robot import SimulatedRobot, make_robot
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry, geometry
from tests.bench.posterior.scenes import ObstacleScene, base_pose, obstacle_scene, render_pair

Array = NDArray[np.float64]
# Ideal images of both cameras, from T_world_base (4, 4)
Shoot = Callable[[Array], tuple[NDArray[np.float32], NDArray[np.float32]]]
# Way [m], and the images (H, W) uint8 of the lower and of the upper camera.
Exposed = tuple[float, NDArray[np.uint8], NDArray[np.uint8]]
STEP_M: Final = 0.05
START_M: Final = -1.2
PERIOD_NS: Final = 100_000_000
STANDING: Final = 8  # pairs before the base starts
RADIUS_M: Final = 0.2  # of the base: nearer directions are not counted, as it would have touched what is there
FARTHEST_M: Final = 4.0
AHEAD_RAD: Final = 0.25
NEIGHBOURS: Final = 2  # directions on either side that an edge may be off
OPEN_M: Final = (1.0, 1.5, 2.0, 3.0)
RANGES_M: Final = (0.8, 1.25, 2.0)  # of the thing itself, between which what is missed is counted
OPEN_MARGIN_M: Final = 0.3  # of the nearest obstacle beyond the place that is to be told as free
ODDS_BINS: Final = (-6.0, -3.0, -1.5, 0.0, 1.5, 3.0, 6.01)


@dataclass(slots=True)
class Scores:
    """Directions of a case by class, and what was said of the way ahead."""

    directions: int = 0
    found: int = 0
    missed: int = 0
    false: int = 0
    of_target: int = 0  # directions whose nearest is the thing itself
    target_found: int = 0
    target_missed: Array = field(default_factory=lambda: np.zeros((len(RANGES_M) + 1, 2)))  # by range: missed, all
    excess_m: list[float] = field(default_factory=list)  # free ahead, more than true, within 1.5 m of it
    open: Array = field(default_factory=lambda: np.zeros((len(OPEN_M), 2)))  # directions free so far: told, true
    milliseconds: list[float] = field(default_factory=list)
    cells: Array = field(default_factory=lambda: np.zeros((len(ODDS_BINS) - 1, 2)))  # free and all, by odds

    def row(self, case: str) -> str:
        """Return a row of the table."""
        share = [f"{100 * n / max(self.directions, 1):.2f} %" for n in (self.found, self.missed, self.false)]
        target = [f"{100 * self.target_found / self.of_target:.1f} %" if self.of_target else "-"]
        each = [*self.target_missed, self.target_missed.sum(axis=0)] if self.of_target else []
        target += [" / ".join(f"{100 * missed / n:.1f}" if n else "-" for missed, n in each) or "-"]
        free = " / ".join(f"{100 * n / max(true, 1):.0f}" for n, true in self.open) + " %"
        excess = f"{100 * max(self.excess_m):.0f} cm" if self.excess_m else "-"
        cells = " | ".join([case, *share, *target, free, excess, f"{np.median(self.milliseconds):.1f}"])
        return f"| {cells} |"


def exposures(shoot: Shoot, robot: SimulatedRobot, steps: int, seed: int) -> Iterator[Exposed]:
    """Yield the way and the images of both cameras of a drive."""
    rng = np.random.default_rng([seed, 61])
    sensors = [
        MountedSensor.of(robot.sensor, camera.visible, camera.camera.size)
        for camera in (robot.rig.lower, robot.rig.upper)
    ]
    for step in range(steps):
        x_m = START_M + STEP_M * step
        ideal = shoot(base_pose(x_m, 0.0, 0.0))
        for _ in range(STANDING if step == 0 else 1):
            lower, upper = (sensor.expose(image, rng) for sensor, image in zip(sensors, ideal, strict=True))
            yield x_m, lower, upper


def drive(case: str, seed: int, robot: SimulatedRobot, steps: int, scores: Scores) -> None:
    """Drive into the room of a case and add to its scores."""
    scene = obstacle_scene(case, seed)
    judge(scene, robot, exposures(partial(render_pair, scene, robot), robot, steps, seed), scores)


def judge(scene: ObstacleScene, robot: SimulatedRobot, images: Iterable[Exposed], scores: Scores) -> ObstacleGrid:
    """Add what the grid says of the images of a drive to the scores; return the grid."""
    config = Config()
    shape: Geometry = geometry(robot.rig, config.panorama)
    grid = ObstacleGrid(FOCAL_PX * shape.rig.baseline_m, RingSettings())
    columns, dewarp = None, Dewarp(shape, config.panorama)
    for number, (x_m, lower, upper) in enumerate(images):
        panoramas = dewarp.process(FramePair(number, number * PERIOD_NS, lower, upper))
        if columns is None:
            columns = columns_of(shape, panoramas, grid)
        begin = time.thread_time()
        evidence = columns.evidence(panoramas.lower, panoramas.upper)
        ring = grid.update(panoramas.stamp_ns, base_pose(x_m, 0.0, 0.0), evidence)
        scores.milliseconds.append(1e3 * (time.thread_time() - begin))
        compare(ring, scene, x_m, scores)
    add_cells(grid, scene, x_m, scores)
    return grid


def usual_robot(size_px: int) -> SimulatedRobot:
    """Return the robot of all cases, with images of a size."""
    robot = make_robot(size_px)
    return replace(robot, rig=with_masks(robot.rig))


def columns_of(shape: Geometry, panoramas: Panoramas, grid: ObstacleGrid) -> Columns:
    """Return the columns for a rig whose T_base_rig has the height above the floor, which the grid takes too."""
    settings = RingSettings()
    T_rect_base = shape.rig.T_rect_rig @ se3.inverse(shape.rig.T_base_rig)
    plane = floor_plane(T_rect_base)
    grid.set_floor(T_rect_base, plane.height_m)
    return Columns(
        shape.cylinder,
        shape.rig.baseline_m,
        plane,
        settings.heights_m,
        (NEAREST_M, settings.max_range_m),
        panoramas.visible,
    )


def compare(ring: GridRing, scene: ObstacleScene, x_m: float, scores: Scores) -> None:
    """Count the directions of a ring."""
    truth = scene.ranges_m(x_m, 0.0, azimuths())
    near = np.where(np.isfinite(truth), truth, 0.0)
    tolerance = 0.1 + 0.03 * near**2
    seen = np.where(np.isnan(ring.ranges_m), np.inf, ring.ranges_m)
    found = np.minimum.reduce([np.roll(seen, shift) for shift in (-1, 0, 1)]) <= truth + tolerance
    missed = ~found & (ring.free_m > truth + tolerance)
    around = np.minimum.reduce([np.roll(truth, shift) for shift in range(-NEIGHBOURS, NEIGHBOURS + 1)])
    with np.errstate(invalid="ignore"):
        false = np.isfinite(seen) & (seen < around - 0.1 - 0.03 * around**2)
    counted = (truth > RADIUS_M) & (truth < FARTHEST_M)
    scores.directions += int(counted.sum())
    scores.found += int((found & counted).sum())
    scores.missed += int((missed & counted).sum())
    scores.false += int((false & counted).sum())
    if len(scene.target):
        target = counted & scene.is_target(x_m, 0.0, azimuths())
        scores.of_target += int(target.sum())
        scores.target_found += int((found & target).sum())
        at_range = np.digitize(truth[target], RANGES_M)
        np.add.at(scores.target_missed, (at_range, 0), missed[target])
        np.add.at(scores.target_missed, (at_range, 1), 1)
    for number, open_m in enumerate(OPEN_M):
        is_open = truth > open_m + OPEN_MARGIN_M
        scores.open[number] += ((is_open & (ring.free_m >= open_m)).sum(), is_open.sum())
    ahead = np.abs(azimuths()) < AHEAD_RAD
    if truth[ahead].min() < 1.5:
        scores.excess_m.append(float(ring.free_m[ahead].min() - truth[ahead].min()))


def floor_odds(odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the log-odds (CELLS, CELLS) that a cell is floor rather than its best other explanation."""
    return np.minimum(np.minimum(odds[FLOOR], odds[VISIBLE]), level_odds(odds))


def add_cells(grid: ObstacleGrid, scene: ObstacleScene, x_m: float, scores: Scores) -> None:
    """Count the cells within 3 m by their log-odds of the floor, and those of them that are free."""
    place = (np.arange(CELLS) + 0.5) * CELL_M
    assert grid._corner is not None
    corner = CELL_M * grid._corner
    px, py = np.meshgrid(place + corner[0] - x_m, place + corner[1])
    distance = np.hypot(px, py)
    inside = (distance < 3.0) & (distance > 0.5)
    truth = scene.ranges_m(x_m, 0.0, np.arctan2(py[inside], px[inside]))
    number = np.digitize(floor_odds(grid._odds)[inside], ODDS_BINS[1:-1])
    np.add.at(scores.cells, (number, 0), distance[inside] < truth)
    np.add.at(scores.cells, (number, 1), 1)
