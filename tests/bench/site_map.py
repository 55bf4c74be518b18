"""A map of a whole site, measured: `python -m tests.bench.site_map [--keyframes 20000] [--seed 601]`.

Keyframes of WORLDS rendered corridors are real. The others are put together: each shows SECTORS sectors of azimuth of
as many real keyframes, turned at random, with noise on their descriptors: so each of them looks like a place, in part
like a real one, and is none. Queries are views beside the paths of the corridors, at any yaw, in other light, with
people and other posters; each is one search among all keyframes, by a robot that knows nothing of where it is. The same
queries are put to a map of 1,000 keyframes that is in memory. Each map is opened by a process of its own.
"""

from __future__ import annotations

import argparse
import gc
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import fit_cylinder
from calib.rig import Rig
from omnid.core.places.features import describe
from omnid.core.places.limits import PlaceLimits
from omnid.core.places.localisation import MapLocaliser
from omnid.core.places.map_pose import OdometryFrame
from omnid.core.places.place_features import PlaceFeatures
from omnid.core.places.place_map import Link, PlaceKeyframe, PlaceMap
from omnid.core.places.place_rig import PlaceRig
from omnid.core.places.place_search import PlaceSearch
from omnid.core.places.signature import THUMBNAIL_SCALE, Thumbnail, thumbnail
from omnid.core.types.stereo_model import StereoModel
from omnid.engine.kernel_cache import prepare_kernels
from omnid.formats.place_file import IN_MEMORY, read_places, write_places
from omnid.simulation.rendering.ray_caster import render_grey
from omnid.tracking_state import MapState
from tests.bench.results import Column, ResultTable
from tests.omnid.core.scenery import RenderedCameras, motion_errors
from tests.simulation import make_rig
from tests.simulation.closed_worlds import ring, two_laps_path, with_other_posters, with_people

Array = NDArray[np.float64]

WORLDS, QUERIES = 8, 10  # rendered corridors, and queries in each of them
LAP_M, APART_M = 18.0, 0.3  # of the path that has keyframes, and between two of them
ROW_M = 20.0  # between two corridors in the map, and between two rows of the other keyframes
SECTORS: Final = 8  # of a keyframe that is put together, each of another real one
NOISE: Final = 8.0  # on the values of descriptors, of some 40: as between two views of a feature
SMALL: Final = 1000  # keyframes of the map in memory
STEPS: Final = 12  # frames of a drive in the map
RIGHT_M, RIGHT_RAD = 0.05, math.radians(0.5)
COVARIANCE: Final = 1e-6 * np.eye(6)


@dataclass(frozen=True, slots=True)
class View:
    """Content of a frame, and its pose in the map."""

    T_map_rect: Array
    thumbnail: Thumbnail
    features: PlaceFeatures


@dataclass(frozen=True, slots=True)
class Measured:
    """Opening of a map and the searches in it."""

    open_s: float
    open_wall_s: float
    memory_mb: float  # more than before the map was opened; largest is that of the opening and the searches
    largest_mb: float
    search_ms: list[float]  # processor time of each query
    right: int
    wrong: int
    reads: int  # of features from the file
    step_ms: list[float]  # processor time of the localiser for each frame of a drive
    localised: int  # frames of the drive


def cameras_of(rig: Rig, seed: int) -> RenderedCameras:
    """Return the cameras in the corridor of a seed."""
    return RenderedCameras.of(rig, ring(seed))


def path_of(seed: int) -> tuple[Array, Array]:
    """Return poses T_world_rig along the corridor, and the path to each [m]."""
    T = two_laps_path(seed, 600)
    return T, np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])


def in_map(number: int, T_world_rig: Array, T_rig_rect: Array) -> Array:
    """Return the pose in the map of a frame in the corridor of that number."""
    return np.asarray(se3.exp([0, ROW_M * number, 0, 0, 0, 0]) @ T_world_rig @ T_rig_rect)


def rendered(rig: Rig, first_seed: int) -> tuple[list[View], list[View]]:
    """Return the real keyframes, and the queries."""
    keyframes, queries = list[View](), list[View]()
    for number in range(WORLDS):
        seed = first_seed + number
        cameras, (T, path_m) = cameras_of(rig, seed), path_of(seed)
        T_rig_rect = se3.inverse(rig.T_rect_rig)
        for n, at_m in enumerate(np.arange(0, LAP_M, APART_M)):
            here = T[np.searchsorted(path_m, at_m)]
            frame = cameras.frame(n, here)
            keyframes.append(View(in_map(number, here, T_rig_rect), thumbnail(frame.lower), describe(frame)))
        rng = np.random.default_rng([seed, 41])
        for n in range(QUERIES):
            here = T[np.searchsorted(path_m, rng.uniform(APART_M, LAP_M - 2 * APART_M))] @ se3.exp(
                [*rng.uniform(-0.28, 0.28, 2), 0, 0, 0, rng.uniform(-np.pi, np.pi)]
            )
            scene = with_people(with_other_posters(ring(seed), rng, 0.2), rng, here[:2, 3])
            bright = float(rng.uniform(0.7, 1.3))
            images = [
                sensor.expose(bright * render_grey(scene, mounted, here), rng)
                for sensor, mounted in zip(cameras.exposures, (rig.lower, rig.upper), strict=True)
            ]
            frame = cameras.stereo_frame(1000 + n, images[0], images[1])
            queries.append(View(in_map(number, here, T_rig_rect), thumbnail(frame.lower), describe(frame)))
    return keyframes, queries


def put_together(views: Sequence[View], T_map_rect: Array, width: int, rng: np.random.Generator) -> View:
    """Return a view of which each sector of azimuth is that of another one, turned at random."""
    small, descriptors, seen = np.zeros_like(views[0].thumbnail), [], []
    columns = small.shape[1] // SECTORS
    for to, number in enumerate(rng.choice(len(views), SECTORS, replace=False)):
        one, of = views[number], int(rng.integers(SECTORS))
        small[:, to * columns : (to + 1) * columns] = one.thumbnail[:, of * columns : (of + 1) * columns]
        inside = np.floor(one.features.views[:, 0] % width * (SECTORS / width)) == of
        moved = one.features.views[inside] + np.float32([(to - of) * width / SECTORS, 0, 0])
        moved[:, 0] %= width
        seen.append(moved)
        descriptors.append(one.features.descriptors[inside])
    exact = np.concatenate(descriptors)
    noisy = np.clip(np.rint(exact + rng.normal(scale=NOISE, size=exact.shape)), 0, 255).astype(np.uint8)
    # As in a real view, the strongest features are spread over all azimuths.
    order = rng.permutation(len(noisy))
    scale = THUMBNAIL_SCALE / max(float(np.sqrt(np.mean(np.square(small, dtype=float)))), 1.0)
    features = PlaceFeatures(noisy[order], np.concatenate(seen)[order])
    return View(T_map_rect, np.clip(np.rint(scale * small), -127, 127).astype(np.int8), features)


def site(views: Sequence[View], count: int, width: int, seed: int) -> Iterator[View]:
    """Yield the keyframes of a map: the real ones, and others in rows beside the corridors."""
    rng, per_row = np.random.default_rng([seed, 44]), round(100 / APART_M)
    yield from views
    for n in range(count - len(views)):
        at = [ROW_M + APART_M * (n % per_row), ROW_M * (n // per_row), 0, 0, 0, 0]
        yield put_together(views, se3.exp(at), width, rng)


def map_of(views: Iterator[View]) -> PlaceMap:
    """Return a map of keyframes, each linked to the next, and every fifth one to that before the one before."""
    places, before = PlaceMap(1 << 30, 1 << 40), list[Array]()
    nothing = np.full(360, np.nan, np.float16), np.zeros(360, np.float16)
    for id, view in enumerate(views):
        T = view.T_map_rect
        keyframe = PlaceKeyframe(id, 0, 10**9 * id, T, COVARIANCE, view.thumbnail, *nothing, view.features)
        places.keyframes[id], places.poses[id] = keyframe, T
        if id:
            places.links.append(Link(id - 1, id, se3.inverse(before[-1]) @ T, COVARIANCE))
        if id % 5 == 4:
            places.links.append(Link(id - 2, id, se3.inverse(before[-2]) @ T, COVARIANCE, 40))
        before.append(T)
    return places


def memory_mb(name: str = "VmRSS") -> float:
    """Return the memory of this process now, or its largest (VmHWM)."""
    return next(float(line.split()[1]) / 1e3 for line in open("/proc/self/status") if line.startswith(name))


def measured(path: Path, feature_bytes: int, queries: Sequence[View], rig: Rig, seed: int) -> Measured:
    """Open a map, search it, and localise in it along the first corridor; in a process of its own."""
    prepare_kernels(lambda _level, _text: None)
    model = StereoModel(fit_cylinder(rig).full_turn, rig.baseline_m)
    search = PlaceSearch(model)
    search.far(queries[0].thumbnail, queries[0].features, map_of(iter(queries[:1])), [0])  # loads what a search needs
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the largest memory from now on
    before_mb = memory_mb()
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    places, _ = read_places(path, PlaceMap(), feature_bytes)
    open_s, open_wall_s = time.process_time() - cpu_s, time.perf_counter() - wall_s
    opened_mb = memory_mb() - before_mb
    ids, times, right, wrong = sorted(places.keyframes), list[float](), 0, 0
    for query in queries:
        begin_s = time.process_time()
        found = search.far(query.thumbnail, query.features, places, ids)
        times.append(1e3 * (time.process_time() - begin_s))
        if found is not None:
            error_m, error_rad = motion_errors(places.poses[found.id] @ found.T_place_rect, query.T_map_rect)
            is_right = error_m < RIGHT_M and error_rad < RIGHT_RAD
            right, wrong = right + is_right, wrong + (not is_right)
    reads = 0 if places.stored is None else places.stored.store.reads
    largest_mb = memory_mb("VmHWM") - before_mb
    cameras = cameras_of(rig, seed)
    frames = [cameras.frame(n, T) for n, T in enumerate(path_of(seed)[0][5 : 5 + 4 * STEPS : 4])]
    localiser = MapLocaliser(model, PlaceLimits(), places, localize_only=True)
    T_rig_rect = se3.inverse(rig.T_rect_rig)
    T_first = path_of(seed)[0][5] @ T_rig_rect
    steps, localised = list[float](), 0
    for n, frame in enumerate(frames):
        T_odom = se3.inverse(T_first) @ path_of(seed)[0][5 + 4 * n] @ T_rig_rect
        given = OdometryFrame(
            frame,
            n * 400_000_000,
            T_odom,
            1e-8 * np.eye(6),
            False,
            0,
            True,
            lambda: np.full(360, np.nan, np.float32),
            lambda: np.zeros(360, np.float32),
        )
        begin_s = time.process_time()
        localised += localiser.process(given).state is MapState.LOCALIZED
        localiser.scans()
        steps.append(1e3 * (time.process_time() - begin_s))
    return Measured(open_s, open_wall_s, opened_mb, largest_mb, times, right, wrong, reads, steps, localised)


def main() -> None:
    """Print a row for each map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=601, help=f"of the first of {WORLDS} corridors")
    args = parser.parse_args()
    table = ResultTable(
        "site_map",
        "A map of a whole site",
        (
            Column("keyframes"),
            Column("file", "MB", 0),
            Column("opens: processor time", "s", 2),
            Column("wall clock", "s", 2),
            Column("memory", "MB", 0),
            Column("largest", "MB", 0),
            Column("queries"),
            Column("right at once", "%", 1),
            Column("wrong"),
            Column("a search: median", "ms", 1),
            Column("p99", "ms", 1),
            Column("most", "ms", 1),
            Column("keyframes read a search", "", 1),
            Column("localised frames of 12"),
            Column("a frame of the localiser: median", "ms", 1),
            Column("most", "ms", 1),
        ),
        [
            "The goals for 20,000: opens in 1 s, at most 300 MB, a search at most 60 ms, recall as with 1,000.",
            "Times of a search are processor times of one thread; the file is in the cache of the system.",
        ],
    )
    rig = make_rig(size=512)
    views, queries = rendered(rig, args.seed)
    cameras = cameras_of(rig, args.seed)
    width = cameras.cylinder.full_turn.width
    of_rig = PlaceRig(cameras.cylinder.full_turn, rig.baseline_m, se3.inverse(rig.T_rect_rig), np.eye(4), "0" * 64)
    assert StereoModel(of_rig.cylinder, of_rig.baseline_m)
    table.seeds = [("two_laps", args.seed + n) for n in range(WORLDS)]
    limits = PlaceLimits()
    with TemporaryDirectory() as folder:
        for count, feature_bytes in ((SMALL, IN_MEMORY), (args.keyframes, limits.max_bytes)):
            path = Path(folder) / f"{count}.omap"
            write_places(path, map_of(site(views, count, width, args.seed)), of_rig)
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                found = pool.submit(measured, path, feature_bytes, queries, rig, args.seed).result()
            table.add(
                count,
                path.stat().st_size / 1e6,
                found.open_s,
                found.open_wall_s,
                found.memory_mb,
                found.largest_mb,
                len(queries),
                100 * found.right / len(queries),
                found.wrong,
                float(np.median(found.search_ms)),
                float(np.percentile(found.search_ms, 99)),
                max(found.search_ms),
                found.reads / len(queries),
                found.localised,
                float(np.median(found.step_ms)),
                max(found.step_ms),
            )


if __name__ == "__main__":
    main()
