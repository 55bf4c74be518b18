"""Monitoring of the rig on panoramas of rendered rooms, with a correct and with wrong rigs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config, PairConfig, PanoramaConfig
from omnid.core.rig.rig_check import POINTS
from omnid.diagnostics.rig_monitor import MIN_PLACES, VIEWS, RigMonitor, start_status
from omnid.engine.flow import NEWEST
from omnid.engine.graph import Graph
from omnid.messages import Panoramas
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry
from omnid.stages.odometry import OdometryStage
from omnid.stages.rig_gate import RigGate
from omnid.stages.stereo import Stereo
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState
from omnid.transport.status_names import RIG
from tests.omnid.core.scenery import wrapped
from tests.simulation import build, write_log
from tests.simulation.readout import PERIOD_NS
from tests.simulation.rigs import with_upper_rotated

SECONDS = 10**9
PERIOD_S = 5.0


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the log of a loop through a room, 24 places."""
    folder = tmp_path_factory.mktemp("rooms")
    run = build("rooms", seed=31, size=256, pairs=24)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=31)
    return folder


class Collector(list[Panoramas]):
    """A sink that keeps all panoramas."""

    def process(self, panoramas: Panoramas) -> None:
        self.append(panoramas)


def monitored(folder: Path, rig: Rig) -> tuple[RigMonitor, Collector]:
    """Run a log through the stages; return the monitor and the panoramas."""
    place, config, graph = geometry(rig, PanoramaConfig()), PanoramaConfig(), Graph(threaded=False)
    monitor, kept = RigMonitor(place.cylinder, PERIOD_NS / SECONDS), Collector()
    frames = graph.source("log", LogReader(folder / "log.mcap").frames)
    pairs = graph.stage("pair", Synchronise(rig, PairConfig()), frames)
    panoramas = graph.stage("dewarp", Dewarp(place, config), pairs)
    graph.sink("rig", monitor, panoramas, policy=NEWEST, depth=1)
    graph.sink("kept", kept, panoramas)
    graph.run()
    return monitor, kept


@pytest.fixture(scope="module")
def true(rooms: Path) -> tuple[RigMonitor, Collector]:
    return monitored(rooms, read_rig(rooms / "rig.toml"))


def monitor_after(
    true: tuple[RigMonitor, Collector], panoramas: Sequence[Panoramas], every_s: float = PERIOD_S
) -> RigMonitor:
    """Return a new monitor after these panoramas, PERIOD_S apart."""
    monitor = RigMonitor(true[0]._cylinder, every_s)
    for number, one in enumerate(panoramas):
        monitor.process(replace(one, seq=number, stamp_ns=round(number * PERIOD_S * SECONDS)))
    return monitor


def test_a_correct_rig_is_good(true: tuple[RigMonitor, Collector]) -> None:
    status = true[0].status()
    assert (status.name, status.level, status.message) == (RIG, 0, "good")
    assert float(status.values["turn_deg"]) < 0.05 and abs(float(status.values["offset_px"])) < 0.03
    assert status.values["condition"] == "good" and int(status.values["new_views"]) == len(true[1]) - VIEWS
    found, sought = int(status.values["matches"]), int(status.values["tried"])
    assert 500 < found < sought and status.values["age_s"] == "1"


@pytest.mark.parametrize("turn_deg", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (0.3, 0.2, -0.35)])
def test_half_a_degree_is_a_warning(rooms: Path, turn_deg: tuple[float, float, float]) -> None:
    monitor, _ = monitored(rooms, with_upper_rotated(read_rig(rooms / "rig.toml"), turn_deg))
    status = monitor.status()
    assert status.level == 1 and status.message.startswith("drifted: ") and monitor.finding and monitor.finding.drift
    assert np.rad2deg(monitor.finding.drift.turn) == pytest.approx(turn_deg, abs=0.05)
    assert float(status.values["turn_deg"]) == pytest.approx(np.linalg.norm(turn_deg), abs=0.05)


def test_three_degrees_are_an_error(rooms: Path) -> None:
    status = monitored(rooms, with_upper_rotated(read_rig(rooms / "rig.toml"), (0.0, 3.0, 0.0)))[0].status()
    assert status.level == 2 and status.message.startswith("broken: ")


def test_a_robot_that_stands_gets_no_finding(true: tuple[RigMonitor, Collector]) -> None:
    status = monitor_after(true, true[1][:1] * 100).status()
    assert (status.level, status.values) == (0, {"new_views": "1", "needed_views": str(VIEWS)})
    assert status.message.startswith("not checked yet")


def test_few_places_give_no_finding_however_often(true: tuple[RigMonitor, Collector]) -> None:
    places = true[1][::3]
    assert monitor_after(true, places[:MIN_PLACES - 1] * 8).finding is None
    found = monitor_after(true, places[:MIN_PLACES] * 6).finding
    assert found is not None and found.condition == "good" and found.tried <= MIN_PLACES * POINTS


def test_uses_no_more_views_than_its_period_allows(true: tuple[RigMonitor, Collector]) -> None:
    assert monitor_after(true, true[1], every_s=PERIOD_S + 1).status().values["new_views"] == str(len(true[1]) // 2)
    back = monitor_after(true, true[1][:4])
    back.process(replace(true[1][9], stamp_ns=1))  # also after the clock was set back
    assert back.status().values["new_views"] == "5"


def test_a_rig_that_moves_during_the_run_is_detected(rooms: Path, true: tuple[RigMonitor, Collector]) -> None:
    _, after = monitored(rooms, with_upper_rotated(read_rig(rooms / "rig.toml"), (0.0, 0.0, 0.5)))
    monitor = monitor_after(true, [*true[1], *after, *after])  # the same loop, where every place was viewed before
    assert monitor.finding is not None and monitor.status().level == 1
    assert monitor.finding.turn_deg == pytest.approx(0.5, abs=0.05)


def test_a_mirror_that_is_knocked_makes_the_poses_degraded(rooms: Path, true: tuple[RigMonitor, Collector]) -> None:
    """Three new views of it are enough, long before a whole check is due."""
    place, config = geometry(read_rig(rooms / "rig.toml"), PanoramaConfig()), Config()
    columns = round(3 / 360 * place.cylinder.width)
    monitor = RigMonitor(place.cylinder, PERIOD_S)
    stereo = Stereo(place, config.stereo, RigGate(place.cylinder, "refuse", lambda: monitor.contradicted))
    odometry = OdometryStage(place, config.odometry)
    for number, good in enumerate(true[1][:8]):
        turned = wrapped(np.roll(good.upper.panorama, columns * (number >= 4), axis=1))
        seen = replace(good, upper=turned, seq=number, stamp_ns=round(number * PERIOD_S * SECONDS))
        monitor.process(seen)
        assert monitor.contradicted == (number >= 6), "the newest three views decide"
        fits = stereo.process(seen).rig_fits
        assert fits != monitor.contradicted
    depth = stereo.process(true[1][8])
    assert monitor.status().level == 2 and not depth.rig_fits
    assert odometry.process(depth).state is TrackingState.DEGRADED
    depth = stereo.process(true[1][9])
    depth.rig_fits = True
    assert odometry.process(depth).state is TrackingState.TRACKING


def test_the_status_tells_the_result_of_the_start(rooms: Path, true: tuple[RigMonitor, Collector]) -> None:
    right = read_rig(rooms / "rig.toml")
    gate = RigGate(true[0]._cylinder, "warn")
    assert start_status(gate).message == "not checked yet"
    for one in true[1][:2]:
        gate.process(one)
    status = start_status(gate)
    assert (status.level, status.message, status.values["condition"]) == (0, "good", "fits") and gate.decided
    for turn_deg, level, words in ((0.8, 1, "do not quite fit"), (3.0, 2, "contradict the rig")):
        _, seen = monitored(rooms, with_upper_rotated(right, (turn_deg, 0.0, 0.0)))
        gate = RigGate(true[0]._cylinder, "warn")
        for one in seen[:4]:
            gate.process(one)
        status = start_status(gate)
        assert status.level == level and words in status.message and gate.contradicted == (level == 2)


@pytest.mark.parametrize(("gain", "noise"), [(0.0, 0.0), (0.0, 2.0), (0.0, 6.0), (0.02, 12.0)])
def test_darkness_is_no_alarm(true: tuple[RigMonitor, Collector], gain: float, noise: float) -> None:
    """In the dark, noise gives points without a match."""
    rng = np.random.default_rng(4)

    def dark(one: Panoramas) -> Panoramas:
        images = [np.clip(w.image * gain + 8 + noise * rng.standard_normal(w.image.shape), 0, 255).astype(np.uint8)
                  for w in (one.lower, one.upper)]
        return replace(one, lower=replace(one.lower, image=images[0]), upper=replace(one.upper, image=images[1]))

    status = monitor_after(true, [dark(one) for one in true[1]]).status()
    assert status.level == 0, status


def test_a_covered_camera_is_an_error(true: tuple[RigMonitor, Collector]) -> None:
    covered = [replace(one, upper=replace(one.upper, image=np.full_like(one.upper.image, 9))) for one in true[1]]
    status = monitor_after(true, covered).status()
    assert status.level == 2 and "covered" in status.message
