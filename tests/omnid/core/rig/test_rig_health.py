"""State of the rig by panoramas of rendered rooms, right rigs and wrong ones; landmarks of a drive."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config, PairConfig, PanoramaConfig
from omnid.core.rig.rig_health import VIEWS, RigContradictedError, RigHealth, RigState
from omnid.core.types.panorama import Panoramas
from omnid.diagnostics.status import rig_stats
from omnid.engine.graph import Graph
from omnid.sinks.drive import LiveDrive
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Dewarp, Geometry, geometry
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport.status_names import RIG, entry
from tests.omnid.core.scenery import wrapped
from tests.simulation import build, write_log
from tests.simulation.logs import PERIOD_NS
from tests.simulation.rigs import with_upper_rotated

# Runs the drive of a rig whose upper camera is turned by degrees about x, y and z.
Turned = Callable[[tuple[float, float, float]], tuple[RigHealth, "Collector"]]
SECONDS = 10**9
PERIOD_S = 5.0


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the log of a loop through a room, 24 places."""
    folder = tmp_path_factory.mktemp("rooms")
    run = build("rooms", seed=31, size=256, pairs=24)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=31)
    return folder


class Driver:
    """A sink of panoramas that shows them to the state as views of a drive, 1 m apart."""

    def __init__(self, health: RigHealth) -> None:
        self._health = health

    def process(self, panoramas: Panoramas) -> None:
        self._health.check_drive(panoramas, np.array([panoramas.seq, 0.0, 0.0]))


class Collector(list[Panoramas]):
    """A sink that keeps all panoramas."""

    def process(self, panoramas: Panoramas) -> None:
        self.append(panoramas)


def monitored(folder: Path, rig: Rig, most: int | None = None) -> tuple[RigHealth, Collector]:
    """Run a log, or at most so many of its pairs, through the stages; return the monitor and the panoramas."""
    place, config, graph = geometry(rig, PanoramaConfig()), PanoramaConfig(), Graph(threaded=False)
    monitor, kept = RigHealth(place.cylinder, "off", PERIOD_NS / SECONDS), Collector()
    reader = LogReader(folder / "log.mcap")
    frames = graph.source("log", lambda: islice(reader.frames(), None if most is None else 2 * most))
    pairs = graph.stage("pair", Synchronise(rig, PairConfig()), frames)
    panoramas = graph.stage("dewarp", Dewarp(place, config), pairs)
    graph.sink("rig", Driver(monitor), panoramas)
    graph.sink("kept", kept, panoramas)
    graph.run()
    return monitor, kept


@pytest.fixture(scope="module")
def place(rooms: Path) -> Geometry:
    return geometry(read_rig(rooms / "rig.toml"), PanoramaConfig())


@pytest.fixture(scope="module")
def true(rooms: Path) -> tuple[RigHealth, Collector]:
    return monitored(rooms, read_rig(rooms / "rig.toml"))


@pytest.fixture(scope="module")
def turned(rooms: Path) -> Turned:
    """Return the drives of turned rigs, up to their finding, each of which runs once."""
    right = read_rig(rooms / "rig.toml")
    return cache(lambda turn_deg: monitored(rooms, with_upper_rotated(right, turn_deg), VIEWS))


def drive(health: RigHealth, panoramas: Iterable[Panoramas], apart_m: float = 1.0) -> RigHealth:
    """Return the state after these views of a drive, PERIOD_S and apart_m apart."""
    for number, one in enumerate(panoramas):
        stamped = replace(one, seq=number, stamp_ns=round(number * PERIOD_S * SECONDS))
        health.check_drive(stamped, np.array([number * apart_m, 0.0, 0.0]))
    return health


def driven(place: Geometry, panoramas: Iterable[Panoramas], apart_m: float = 1.0) -> RigHealth:
    return drive(RigHealth(place.cylinder, "off", PERIOD_S), panoramas, apart_m)


def started(place: Geometry, pairs: Iterable[Panoramas], mode: str = "warn") -> RigHealth:
    """Return the state after first pairs."""
    health = RigHealth(place.cylinder, mode, PERIOD_S)
    for one in pairs:
        health.check_first(one)
    return health


def test_a_correct_rig_is_good(true: tuple[RigHealth, Collector]) -> None:
    status = entry(RIG, rig_stats(true[0]))
    assert (status.name, status.level, status.message) == (RIG, 0, "fits")
    finding = true[0].finding
    assert finding is not None and finding.turn_deg < 0.05 and len(true[0].views) == VIEWS
    assert 500 < finding.matches < finding.tried


@pytest.mark.parametrize("turn_deg", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (0.3, 0.2, -0.35)])
def test_half_a_degree_is_a_warning(turned: Turned, turn_deg: tuple[float, float, float]) -> None:
    monitor, _ = turned(turn_deg)
    status = entry(RIG, rig_stats(monitor))
    assert status.level == 1 and "drifted" in status.message and monitor.finding and monitor.finding.drift
    assert np.rad2deg(monitor.finding.drift.turn) == pytest.approx(turn_deg, abs=0.05)


def test_a_robot_at_rest_gets_no_finding(place: Geometry, true: tuple[RigHealth, Collector]) -> None:
    health = driven(place, true[1][:1] * 100, 0.0)
    status = entry(RIG, rig_stats(health))
    assert (status.level, status.message, len(health.views)) == (0, "unchecked", 1)


def test_a_rig_that_moves_during_the_run_is_detected(
    place: Geometry, turned: Turned, true: tuple[RigHealth, Collector]
) -> None:
    _, after = turned((0.0, 0.0, 0.5))
    monitor = driven(place, [*true[1], *after, *after])  # the same loop, where every place was viewed before
    assert monitor.finding is not None and monitor.state is RigState.DRIFTED
    assert monitor.finding.turn_deg == pytest.approx(0.5, abs=0.05)


@pytest.mark.hazard("H35")
def test_a_mirror_that_is_knocked_makes_the_poses_degraded(place: Geometry, true: tuple[RigHealth, Collector]) -> None:
    """Three new views of it are enough, long before a whole check is due."""
    config = Config()
    columns = round(3 / 360 * place.cylinder.width)
    health = RigHealth(place.cylinder, "refuse", PERIOD_S)
    poses = FrontEnd(place, config, health)
    for number, right in enumerate(true[1][:8]):
        turned = wrapped(np.roll(right.upper.panorama, columns * (number >= 4), axis=1))
        shown = replace(right, upper=turned, stamp_ns=round(number * PERIOD_S * SECONDS))
        health.check_drive(shown, np.array([number, 0.0, 0.0]))
        assert health.state.is_contradicted == (number >= 6), "the newest three views decide"
    assert entry(RIG, rig_stats(health)).level == 2
    assert poses.process(true[1][8]).state is TrackingState.DEGRADED
    fits = FrontEnd(place, config, RigHealth(place.cylinder, "refuse", PERIOD_S))
    assert fits.process(true[1][8]).state is TrackingState.TRACKING


@pytest.mark.hazard("H35")
def test_the_wheels_get_no_pose_before_the_first_pairs_were_judged(
    place: Geometry, turned: Turned, true: tuple[RigHealth, Collector]
) -> None:
    """Two pairs show that a rig is right; one that seems wrong is judged again before the run ends by it."""
    for pairs, needed in ((true[1][:4], 2), (turned((3.0, 0.0, 0.0))[1][:4], 4)):
        sent: list[object] = []
        front_end = FrontEnd(place, Config(), RigHealth(place.cylinder, "warn", PERIOD_S))
        drive = LiveDrive(SimpleNamespace(send=sent.append), np.eye(4), front_end.health)  # type: ignore[arg-type]
        for number, pair in enumerate(pairs, 1):
            drive.process(front_end.process(replace(pair, stamp_ns=number * SECONDS)))
            assert bool(sent) == (number >= needed)


def test_the_status_has_the_result_of_the_start(
    rooms: Path, place: Geometry, turned: Turned, true: tuple[RigHealth, Collector]
) -> None:
    """A right rig needs one round of two pairs, a contradiction two rounds that agree."""
    health = started(place, [])
    assert entry(RIG, rig_stats(health)).message == "unchecked" and health.state is RigState.UNCHECKED
    assert started(place, true[1][:1]).state is RigState.UNCHECKED
    health = started(place, true[1][:2])
    status = entry(RIG, rig_stats(health))
    assert (status.level, status.message, status.values["state"]) == (0, "fits", "fits") and not health.is_checking
    for turn_deg, pairs, level, words in ((0.8, 2, 1, "do not quite fit"), (3.0, 4, 2, "contradict the rig")):
        seen = turned((turn_deg, 0.0, 0.0))[1]
        assert started(place, seen[: pairs - 1]).state is RigState.UNCHECKED
        health = started(place, seen[:pairs])
        status = entry(RIG, rig_stats(health))
        assert status.level == level and words in status.message
        assert health.state is (RigState.BROKEN if level == 2 else RigState.DRIFTED)
    with pytest.raises(RigContradictedError, match="contradict the rig"):
        started(place, seen[:4], "refuse")


def test_the_drive_overrules_the_start_except_for_exchanged_cameras(
    place: Geometry, turned: Turned, true: tuple[RigHealth, Collector]
) -> None:
    _, wrong = turned((0.0, 3.0, 0.0))
    exchanged = [replace(one, lower=one.upper, upper=one.lower) for one in true[1]]
    for first, later, state in (
        (wrong, true[1], RigState.FITS),
        (true[1], wrong, RigState.BROKEN),
        (exchanged, true[1], RigState.EXCHANGED),
    ):
        health = started(place, first[:4])
        begun = health.state
        drive(health, later[:VIEWS])
        assert health.state is state and begun in (state, RigState.BROKEN, RigState.FITS)
    assert entry(RIG, rig_stats(health)).level == 2 and "exchange" in entry(RIG, rig_stats(health)).message


def darkened(one: Panoramas, gain: float, noise: float) -> Panoramas:
    rng = np.random.default_rng(4)
    images = [
        np.clip(w.image * gain + 8 + noise * rng.standard_normal(w.image.shape), 0, 255).astype(np.uint8)
        for w in (one.lower, one.upper)
    ]
    return replace(one, lower=replace(one.lower, image=images[0]), upper=replace(one.upper, image=images[1]))


@pytest.mark.parametrize(("gain", "noise"), [(0.0, 0.0), (0.0, 6.0), (0.02, 12.0)])
def test_darkness_is_no_alarm(place: Geometry, true: tuple[RigHealth, Collector], gain: float, noise: float) -> None:
    """In the dark, noise gives points without a match."""
    status = entry(RIG, rig_stats(driven(place, [darkened(one, gain, noise) for one in true[1]])))
    assert status.level == 0 and status.values["state"] == "unchecked", status
