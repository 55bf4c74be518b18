"""Recall and false alarms of the obstacle ring against the true world: `python -m tests.bench.log_rings LOG ...`.

LOG is a folder NAME_sN of `python -m tests.simulation NAME --seed N` (NAME_dim_sN: with --dim); the world is built
again from the name and the seed. A sector counts as found where the ring has an obstacle no farther than the true one
and its tolerance, as unknown where it has none and does not call the way free beyond the obstacle, and as missed where
it has a farther one or none in a direction that it calls free; how many of all are called free is given, too, as what
lies before a farther obstacle may be unknown. A false alarm is an obstacle before the nearest true one.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.rig_file import read_rig
from omnid.config import load_config
from omnid.core.mapping.range_scan import SECTORS
from omnid.formats.tum import read_tum
from omnid.messages import ObstacleRing
from omnid.runs.replay import ReplayOptions, run_log
from omnid.sinks.encoder import Outgoing
from tests.bench.results import Cell, Column, ResultTable
from tests.bench.seeds import family_and_seed
from tests.simulation import RECIPES, Rectangle, build

Array = NDArray[np.float64]
RAYS: Final = 3  # true directions for each sector
NEIGHBOURS: Final = 2  # sectors on either side that an edge may be off
DISTANCES_M: Final = (0.3, 0.65, 1.0, 1.5, 2.0, 3.0, 4.0)
LOWEST_M: Final = 0.05  # of a surface within the band of heights that counts
CLASSES: Final = ("found", "unknown", "missed")
WALLS: Final = ("brick", "granite", "plaster", "plain")


@dataclass(frozen=True, slots=True, eq=False)
class TrueRing:
    """Nearest surfaces around a place."""

    near_m: Array  # (SECTORS,) nearest of the sector, inf without one
    kind: NDArray[np.str_]  # (SECTORS,) of it


@dataclass(slots=True)
class Counts:
    """Sectors by class, for each group."""

    of: dict[str, dict[str, int]] = field(default_factory=dict)
    called_free: dict[str, int] = field(default_factory=dict)  # beyond the true obstacle
    false_alarms: dict[str, int] = field(default_factory=dict)
    ranges: dict[str, int] = field(default_factory=dict)  # that the ring gave
    errors_m: dict[str, list[float]] = field(default_factory=dict)

    def add(self, group: str, classes: Iterable[str]) -> None:
        """Count sectors."""
        counts = self.of.setdefault(group, dict.fromkeys(CLASSES, 0))
        for one in classes:
            counts[one] += 1


class Segments:
    """Upright surfaces of a world within the band of heights, as segments on the floor."""

    def __init__(self, rectangles: Iterable[Rectangle], band_m: tuple[float, float]) -> None:
        ends, kinds = [], []
        for rectangle in rectangles:
            corners = rectangle.corners
            low, high = corners[:, 2].min(), corners[:, 2].max()
            if high - low > 0.01 and min(high, band_m[1]) - max(low, band_m[0]) > LOWEST_M:
                far = corners[np.argmax(((corners - corners[0])[:, :2] ** 2).sum(axis=1))]
                ends.append([corners[0, :2], far[:2]])
                kinds.append(_kind(rectangle, float(high)))
        self.ends, self.kinds = np.array(ends), np.array(kinds)

    def ring(self, x_m: float, y_m: float, yaw_rad: float) -> TrueRing:
        """Return the true ring at a pose."""
        azimuth = yaw_rad - np.pi + (np.arange(SECTORS * RAYS) + 0.5) * (2 * np.pi / (SECTORS * RAYS))
        direction = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        start, along = self.ends[:, 0] - [x_m, y_m], self.ends[:, 1] - self.ends[:, 0]
        across = direction[:, None, 0] * along[None, :, 1] - direction[:, None, 1] * along[None, :, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
            share = (start[None, :, 0] * direction[:, None, 1] - start[None, :, 1] * direction[:, None, 0]) / across
        hit = np.where((distance > 0) & (share >= 0) & (share <= 1), distance, np.inf)
        nearest = np.argmin(hit, axis=1)
        ranges = hit[np.arange(len(hit)), nearest].reshape(SECTORS, RAYS)
        best = np.argmin(ranges, axis=1)
        kinds = self.kinds[nearest].reshape(SECTORS, RAYS)
        return TrueRing(ranges[np.arange(SECTORS), best], kinds[np.arange(SECTORS), best])


def tolerance_m(range_m: Array) -> Array:
    """Return by how much a range may differ: three sigma of stereo, and the size of an edge."""
    return np.asarray(0.1 + 0.03 * range_m**2)


def compare(ring: ObstacleRing, truth: TrueRing, light: str, counts: Counts) -> None:
    """Count the sectors of a ring."""
    around = np.array([np.roll(truth.near_m, shift) for shift in range(-NEIGHBOURS, NEIGHBOURS + 1)])
    seen = np.array([np.roll(ring.ranges_m, shift) for shift in range(-NEIGHBOURS, NEIGHBOURS + 1)])
    nearest_seen = np.where(np.isnan(seen), np.inf, seen).min(axis=0)
    known = np.isfinite(ring.ranges_m)
    limit = truth.near_m + tolerance_m(np.where(np.isfinite(truth.near_m), truth.near_m, 0.0))
    is_found = nearest_seen <= limit
    is_unknown = ~is_found & np.isnan(ring.ranges_m) & (ring.free_m <= limit)
    classes = np.where(is_found, "found", np.where(is_unknown, "unknown", "missed"))
    is_free = ~is_found & (ring.free_m > limit)
    least = around.min(axis=0)
    is_false = known & (ring.ranges_m < least - tolerance_m(least))
    inside = (truth.near_m >= DISTANCES_M[0]) & (truth.near_m < DISTANCES_M[-1])
    bins = np.digitize(truth.near_m, DISTANCES_M)
    for k in np.flatnonzero(inside):
        distance = f"{DISTANCES_M[bins[k] - 1]:g} to {DISTANCES_M[bins[k]]:g} m"
        for group in (f"distance|{distance}", f"surface|{truth.kind[k]}", f"light|{light}", "all|all"):
            counts.add(group, [classes[k]])
            counts.called_free[group] = counts.called_free.get(group, 0) + int(is_free[k])
            counts.false_alarms[group] = counts.false_alarms.get(group, 0) + int(is_false[k])
            counts.ranges[group] = counts.ranges.get(group, 0) + int(known[k])
            if is_found[k] and known[k]:
                counts.errors_m.setdefault(group, []).append(float(ring.ranges_m[k] - truth.near_m[k]))


class RingCollector:
    """Rings of a run."""

    def __init__(self) -> None:
        self.rings: list[ObstacleRing] = []

    def process(self, message: Outgoing) -> None:
        """Keep a ring."""
        if isinstance(message, ObstacleRing):
            self.rings.append(message)


def measure(folder: Path, overrides: list[str], counts: Counts) -> None:
    """Replay a log and count its rings, from the second on: the first has no votes."""
    match = re.fullmatch(r"(.+?)(_dim)?_s(\d+)", folder.name)
    if match is None or match[1] not in RECIPES:
        raise SystemExit(f"{folder}: expected a folder NAME_sN with NAME one of {', '.join(sorted(RECIPES))}")
    rig, truth = read_rig(folder / "rig.toml"), read_tum(folder / "truth.txt")
    config = load_config(None, ["places.enabled=false", *overrides])
    found = RingCollector()
    run_log(
        folder / "log.mcap", config, ReplayOptions(rig=rig, inline=True, observer=lambda geometry, telemetry: found)
    )
    scene = build(match[1], int(match[3]), pairs=len(truth.T)).scene
    segments = Segments(scene.rectangles, config.obstacles.ring.heights_m)
    poses = dict(zip(truth.stamps_ns.tolist(), truth.T @ np.linalg.inv(rig.T_base_rig), strict=True))
    for ring in found.rings[1:]:
        T = poses[ring.stamp_ns]
        yaw = float(np.arctan2(T[1, 0], T[0, 0]))
        compare(ring, segments.ring(float(T[0, 3]), float(T[1, 3]), yaw), "dim" if match[2] else "bright", counts)


def _kind(rectangle: Rectangle, top_m: float) -> str:
    if rectangle.name in WALLS:
        return f"wall, {rectangle.name}"
    if rectangle.name.startswith("poster"):
        return "poster"
    height = "below 0.4 m" if top_m < 0.4 else "0.4 to 0.8 m" if top_m < 0.8 else "above 0.8 m"
    return f"box {height}"


def rows(counts: Counts) -> Iterator[list[Cell]]:
    """Yield the rows of the table."""
    order = {group: i for i, group in enumerate(("distance", "surface", "light", "all"))}
    for group in sorted(counts.of, key=lambda name: (order[name.split("|")[0]], name)):
        total = sum(counts.of[group].values())
        shares = [100 * counts.of[group][one] / total for one in CLASSES]
        errors = np.abs(counts.errors_m.get(group, [np.nan]))
        yield [
            group.split("|")[1],
            total,
            *shares,
            100 * counts.called_free[group] / total,
            100 * counts.false_alarms[group] / max(1, counts.ranges[group]),
            100 * float(np.median(errors)),
            100 * float(np.quantile(errors, 0.95)),
        ]


def main() -> None:
    """Print the table of all logs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    counts = Counts()
    for folder in arguments.logs:
        measure(folder, arguments.overrides, counts)
    columns = (
        Column("sectors of"),
        Column("number"),
        *(Column(one, "%", 2 if one == "missed" else 1) for one in CLASSES),
        Column("called free", "%", 2),
        Column("false alarms of ranges", "%", 2),
        Column("error, median", "cm", 1),
        Column("error, p95", "cm", 1),
    )
    table = ResultTable("obstacles", "Recall of the obstacle ring", columns)
    table.seeds = [seed for folder in arguments.logs if (seed := family_and_seed(folder.name))]
    for row in rows(counts):
        table.add(*row)


if __name__ == "__main__":
    main()
