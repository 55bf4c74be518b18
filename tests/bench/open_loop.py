"""Stored pairs along the ways of worlds like buildings, with the truth: `tests.bench.obstacles --open-loop FOLDER`.

Nothing stops the base: it drives on until it is 0.15 m from what is in the way. Each drive is a file of numpy, which
any method can be tried on, and what today's scan showed of it. Arrays by pair (N): lower, upper (N, H, W) uint8;
stamps_ns; T_world_base (N, 4, 4), true; first_m (N, 360), the range from the base's origin in its sectors to the first
object that the base would touch, of the heights that it sweeps, or to where the floor falls; inf: none; scan_m,
sigma_m, free_m (N, 360) of the scan, NaN where there was none. cells (2, D): cells of the grids of all pairs by their
said probability of an object, in steps of DECADES, and those of them that an object is in. Of the world: T_base_rig
(4, 4), as its file says; profile (P, 2), the heights z of the floor at places x; radius_m and height_m of the base.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.se2_arrays import planar, transform
from drivers.frame import Frame, gray
from omnid.config import load_config
from omnid.core.control.heading_controller import Setpoint
from omnid.core.mapping.range_scan import SECTORS, azimuths
from omnid.core.obstacles.grid import FloorGrid
from omnid.simulation.robot import START_NS
from omnid.simulation.world import Walkers, clearance_m
from tests.bench.obstacles import Planned, prepared, settings_for
from tests.bench.results import ResultTable, columns
from tests.simulation.disturbed import simulate
from tests.simulation.lockstep import Moment, Request

Array = NDArray[np.float64]
EVERY: Final = 3  # pair that is stored
LONGEST_M: Final = 4.0  # of the way that is stored
NEAR_M: Final = 0.15  # from the outline to what is in the way, where a drive ends
LOOK_M, LOOK_RAD = 3.0, np.radians(15.0)  # what counts of a scan
BEYOND_M: Final = 0.1
DECADES: Final = (0.0, 3e-4, 1e-3, 1e-2, 0.1, 0.5, 0.9, 1.0)  # probabilities of a cell; none is below 1.2e-4


def said_and_true(grid: FloorGrid, segments: Array, T_odom_world: Array) -> NDArray[np.intp]:
    """Return known cells (2, D) by their probability, and those that segments (M, 2, 2) in the world cross."""
    points = segments.reshape(-1, 2) @ T_odom_world[:2, :2].T + T_odom_world[:2, 3]
    ends = np.stack(grid.at(points)[::-1], axis=1).reshape(-1, 2, 2)
    is_taken = np.zeros(grid.occupied.shape, np.uint8)
    for first, last in ends.astype(int).tolist():
        cv2.line(is_taken, first, last, 1)
    known = np.isfinite(grid.occupied)
    return np.stack([np.histogram(grid.occupied[part], DECADES)[0] for part in (known, known & (is_taken > 0))])


def ranges_m(segments: Array, place: tuple[float, float], azimuths_rad: Array) -> Array:
    """Return the distances (N,) [m] from a place to the first of segments (M, 2, 2) along azimuths (N,); inf: none."""
    if not len(segments):
        return np.full(len(azimuths_rad), np.inf)
    ray = np.column_stack([np.cos(azimuths_rad), np.sin(azimuths_rad)])
    start, along = segments[:, 0] - place, segments[:, 1] - segments[:, 0]
    across = ray[:, None, 0] * along[:, 1] - ray[:, None, 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance_m = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        share = (start[:, 0] * ray[:, None, 1] - start[:, 1] * ray[:, None, 0]) / across
    met = (distance_m > 0) & (share >= 0) & (share <= 1)
    return np.asarray(np.where(met, distance_m, np.inf).min(axis=1))


def stored(planned: Planned, folder: Path) -> Path:
    """Return the file of a drive, which is made where there is none."""
    path = folder / f"{planned}.npz".replace(" ", "_").replace(",", "").replace("/", "p")
    if path.exists():
        return path
    asked, robot = prepared(planned)
    segments, people, images, kept = asked.world.obstacles(robot.height_m), Walkers(asked.world.people), {}, {}

    def kept_image(_: float, frame: Frame) -> Frame:
        if frame.seq % EVERY == 0:
            images[frame.camera, frame.stamp_ns] = gray(frame)
        return frame

    def on(moment: Moment) -> Iterator[Request]:
        if moment.odometry is not None and not moment.controller.armed:
            yield "arm"
        x_m, y_m = moment.T_world_base[:2, 3].tolist()
        people.advance(moment.time_s, (x_m, y_m))
        all_segments = np.concatenate([segments, asked.world.footprints(people.faces(), robot.height_m)])
        heading_rad = float(np.arctan2(moment.T_world_base[1, 0], moment.T_world_base[0, 0]))
        first_m = ranges_m(all_segments, (x_m, y_m), azimuths() + heading_rad)
        kept[START_NS + round(moment.time_s * 1e9)] = moment.T_world_base, first_m, all_segments
        is_near = clearance_m(all_segments, (x_m, y_m), robot.radius_m) < NEAR_M
        driven_m = float(np.linalg.norm(np.array([x_m, y_m]) - asked.world.start[:2]))
        yield Setpoint(planned.speed_mps, heading_rad=0.0)
        if (is_near and driven_m > NEAR_M) or driven_m > LONGEST_M:
            yield "end"

    config = load_config(None, [*settings_for(planned), "controller.collision.check=false"])
    seconds = 3.0 + LONGEST_M / abs(planned.speed_mps)
    run = simulate(asked.world, robot, on, seconds=seconds, seed=planned.seed, config=config, tamper=kept_image)
    scans = {scan.stamp_ns: scan for scan in run.scans}
    stamps = [stamp_ns for camera, stamp_ns in images if camera == "lower" and stamp_ns in kept]
    none, cells = np.full(SECTORS, np.nan), np.zeros((2, len(DECADES) - 1), np.intp)
    for stamp_ns, scan in scans.items():
        if scan.grid is not None and stamp_ns in kept:
            T_world_base, _, all_segments = kept[stamp_ns]
            T_odom_world = transform(planar(scan.T_odom_base)) @ se3.inverse(transform(planar(T_world_base)))
            cells += said_and_true(scan.grid, all_segments, T_odom_world)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        lower=np.array([images["lower", stamp_ns] for stamp_ns in stamps]),
        upper=np.array([images["upper", stamp_ns] for stamp_ns in stamps]),
        stamps_ns=np.array(stamps, np.int64),
        T_world_base=np.array([kept[stamp_ns][0] for stamp_ns in stamps]),
        first_m=np.array([kept[stamp_ns][1] for stamp_ns in stamps], np.float32),
        scan_m=np.array([scans[s].ranges_m if s in scans else none for s in stamps], np.float32),
        sigma_m=np.array([scans[s].sigma_m if s in scans else none for s in stamps], np.float32),
        free_m=np.array([scans[s].free_m if s in scans else none for s in stamps], np.float32),
        cells=cells,
        T_base_rig=run.T_base_rig,
        profile=np.array(asked.world.ground.profile or [(0.0, 0.0)]),
        radius_m=robot.radius_m,
        height_m=robot.height_m,
    )
    return path


def shares(path: Path, *, backwards: bool) -> tuple[int, float, float]:
    """Return the number of scans, the share of 3 m ahead that they call free, and of rays that are falsely free."""
    with np.load(path) as file:
        free_m, first_m = (np.asarray(file[name], float) for name in ("free_m", "first_m"))
    told = np.isfinite(free_m).all(axis=1)
    about_rad = azimuths() - (np.pi if backwards else 0.0)
    looked = np.abs(np.arctan2(np.sin(about_rad), np.cos(about_rad))) < LOOK_RAD
    free_m, first_m = (np.minimum(part[told][:, looked], LOOK_M) for part in (free_m, first_m))
    free = float(np.minimum(free_m, first_m).sum() / max(first_m.sum(), 1e-9))
    return int(told.sum()), free, float((free_m > first_m + BEYOND_M).mean()) if told.any() else float("nan")


def add_scan_table(paths: Sequence[Path]) -> None:
    """Print and write the errors of ranges against the truth, by metre of it."""
    parts = []
    for path in paths:
        with np.load(path) as file:
            parts.append(np.array([file[name] for name in ("scan_m", "first_m", "sigma_m")], float).reshape(3, -1))
    scan_m, first_m, sigma_m = np.concatenate(parts, axis=1)
    head = columns("range|m", "ranges", "median error|m|3", "90 % of the magnitudes|m|3", "68 % of them by sigma||1")
    table = ResultTable("obstacles_scan", "Ranges of the scan against the truth", head)
    for metre in range(math.ceil(np.nanmax(first_m, where=np.isfinite(first_m), initial=0.0))):
        chosen = np.isfinite(scan_m) & (first_m >= metre) & (first_m < metre + 1)
        if chosen.any():
            error_m = scan_m[chosen] - first_m[chosen]
            by_sigma = np.quantile(np.abs(error_m) / sigma_m[chosen], 0.68)
            most_m = np.quantile(np.abs(error_m), 0.9)
            table.add(f"{metre} to {metre + 1}", int(chosen.sum()), np.median(error_m), most_m, by_sigma)


def add_reliability_table(paths: Sequence[Path]) -> None:
    """Print and write the share of cells in which an object is, by the probability of one that the grid says."""
    cells = sum(np.load(path)["cells"] for path in paths)
    head = columns("said probability", "cells", "true share||5")
    table = ResultTable("obstacles_reliability", "Cells of the grid against the truth", head)
    for low, high, (count, taken) in zip(DECADES, DECADES[1:], np.transpose(cells), strict=False):
        table.add(f"{low:g} to {high:g}", int(count), float(taken / max(count, 1)))


def judge_scans(wanted: Sequence[Planned], folder: Path, jobs: int) -> None:
    """Make the files that are missing, and print a row for each world."""
    ahead = "free of what is free up to 3 m, within 15 degrees|%|0"
    head = columns("world", "scans", ahead, "rays falsely free more than 0.1 m beyond the first object|%|1")
    table = ResultTable("obstacles_open_loop", "The obstacle scan on stored pairs", head)
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        paths = list(pool.map(stored, wanted, [folder] * len(wanted)))
    for planned, path in zip(wanted, paths, strict=True):
        count, free, false = shares(path, backwards=planned.speed_mps < 0)
        table.add(str(planned), count, 100 * free, 100 * false, seed=("buildings", planned.seed))
    add_scan_table(paths)
    add_reliability_table(paths)
