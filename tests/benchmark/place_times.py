"""Processor times of the map of places, on synthetic maps: `python -m tests.benchmark.place_times`."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from omnid.core.mapping.scan_grid import scan_grid
from omnid.core.places.particle_filter import ParticleFilter
from omnid.core.places.place_search import PlaceSearch
from omnid.core.places.pose_graph import optimise
from omnid.core.types.stereo_model import StereoModel
from omnid.formats.place_file import read_places, write_places
from tests.benchmark.results import Column, ResultTable
from tests.omnid.core.mapping.rooms import pose, scan_of
from tests.omnid.core.places.graphs import laps
from tests.omnid.core.places.test_particle_filter import CORNERED, MAPPED, drive, grid_of
from tests.omnid.formats.place_maps import RIG, some_places


def seconds(work: Callable[[], object], runs: int = 3) -> float:
    """Return the median processor time of some runs."""
    times = []
    for _ in range(runs):
        begin_s = time.process_time()
        work()
        times.append(time.process_time() - begin_s)
    return float(np.median(times))


def main() -> None:
    """Print the table."""
    graph = laps(1, nodes=2000, per_lap=250, loops=200, wrong=0.1)
    result = optimise(graph.start, graph.edges)
    accepted = result.accepted[len(graph.odometry) :]
    rng, room = np.random.default_rng(0), CORNERED
    poses = np.array([pose(*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)) for _ in range(1000)])
    scans = [scan_of(room, T) for T in poses]
    particles = ParticleFilter(grid_of(room, MAPPED), 1)
    path = drive(pose(-1, 0.2, 1), 12, 0.3)
    for T in path:
        particles.update(scan_of(room, T))
        particles.move(pose(0.2, 0, 0.3))
    with TemporaryDirectory() as folder:
        path_of_map, places = Path(folder) / "a.omap", some_places(999)
        write_places(path_of_map, places, RIG)
        size = path_of_map.stat().st_size
        search, queries = PlaceSearch(StereoModel(RIG.cylinder, RIG.baseline_m)), some_places(3, 200, seed=7)
        query, ids = queries.keyframes[1], sorted(places.keyframes)
        rows = (
            (
                "pose graph: 2,000 nodes, 200 loops, 10 % of them wrong",
                seconds(lambda: optimise(graph.start, graph.edges)),
                f"{result.steps} steps, {int(accepted[~graph.right].sum())} wrong and "
                f"{int((~accepted[graph.right]).sum())} right loops misjudged",
            ),
            (
                "map of 999 keyframes: read",
                seconds(lambda: read_places(path_of_map)),
                f"{size / 999 / 1e3:.1f} kB each",
            ),
            ("the same: written, synced, read again", seconds(lambda: write_places(path_of_map, places, RIG)), ""),
            (
                "search of a frame in all of it, which shows no place of it",
                seconds(lambda: search.far(query.thumbnail, query.features, places, ids), 5),
                f"{places.nbytes / 1e6:.0f} MB in memory",
            ),
            ("grid of 1,000 range scans, 0.05 m", seconds(lambda: scan_grid(scans, scans, poses, 0.05)), ""),
            ("particle filter: one update, 1,000 particles", seconds(lambda: particles.update(scans[0]), 25), ""),
        )
    table = ResultTable(
        "place_times",
        "speed",
        "Times of the map of places",
        (Column("what"), Column("processor time", "ms", 1), Column("remark")),
    )
    for name, taken_s, note in rows:
        table.add(name, 1e3 * taken_s, note)


if __name__ == "__main__":
    main()
