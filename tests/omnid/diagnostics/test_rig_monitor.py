"""The daemon's own look at its rig: on the panoramas of rendered rooms, with a rig that is true and one that is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.logs.mcap_reader import LogReader
from omnid.config import PairConfig, PanoramaConfig
from omnid.core.rig.rig_check import POINTS
from omnid.diagnostics.rig_monitor import MIN_PLACES, PAIRS, RigMonitor
from omnid.engine.flow import NEWEST
from omnid.engine.graph import Graph
from omnid.messages import Panoramas
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import geometry
from omnid.stages.synchronise import Synchronise
from tests.simulation import build, write_log
from tests.simulation.logs import PERIOD_NS
from tests.simulation.rigs import with_upper_rotated

SECONDS = 10**9
LOOK_S = 5.0


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a round through a room, 24 places."""
    folder = tmp_path_factory.mktemp("rooms")
    run = build("rooms", seed=31, size=256, pairs=24)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=31)
    return folder


class Kept(list[Panoramas]):
    """A sink that keeps everything."""

    def process(self, panoramas: Panoramas) -> None:
        self.append(panoramas)


def watched(folder: Path, rig: Rig) -> tuple[RigMonitor, Kept]:
    """A whole run over a log, as the daemon does it."""
    place, config, graph = geometry(rig, PanoramaConfig()), PanoramaConfig(), Graph(threaded=False)
    watch, kept = RigMonitor(place.cylinder, PERIOD_NS / SECONDS), Kept()
    frames = graph.source("log", LogReader(folder / "log.mcap").frames)
    pairs = graph.stage("pair", Synchronise(rig, PairConfig()), frames)
    panoramas = graph.stage("dewarp", Dewarp(place, config), pairs)
    graph.sink("rig", watch, panoramas, policy=NEWEST, depth=1)
    graph.sink("kept", kept, panoramas)
    graph.run()
    return watch, kept


@pytest.fixture(scope="module")
def true(rooms: Path) -> tuple[RigMonitor, Kept]:
    return watched(rooms, read_rig(rooms / "rig.toml"))


def fed(true: tuple[RigMonitor, Kept], panoramas: Sequence[Panoramas], every_s: float = LOOK_S) -> RigMonitor:
    """A new watch after those panoramas, LOOK_S apart."""
    watch = RigMonitor(true[0]._cylinder, every_s)
    for number, one in enumerate(panoramas):
        watch.process(replace(one, seq=number, stamp_ns=round(number * LOOK_S * SECONDS)))
    return watch


def test_a_true_rig_is_good(true: tuple[RigMonitor, Kept]) -> None:
    status = true[0].status()
    assert (status.name, status.level, status.message) == ("omnid: rig", 0, "good")
    assert float(status.values["turn_deg"]) < 0.05 and abs(float(status.values["offset_px"])) < 0.03
    assert status.values["verdict"] == "good" and int(status.values["new_views"]) == len(true[1]) - PAIRS
    found, sought = int(status.values["matches"]), int(status.values["tried"])
    assert 500 < found < sought and status.values["age_s"] == "1"


@pytest.mark.parametrize("turn_deg", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (0.3, 0.2, -0.35)])
def test_half_a_degree_is_a_warning(rooms: Path, turn_deg: tuple[float, float, float]) -> None:
    watch, _ = watched(rooms, with_upper_rotated(read_rig(rooms / "rig.toml"), turn_deg))
    status = watch.status()
    assert status.level == 1 and status.message.startswith("drifted: ") and watch.finding and watch.finding.drift
    assert np.rad2deg(watch.finding.drift.turn) == pytest.approx(turn_deg, abs=0.05)
    assert float(status.values["turn_deg"]) == pytest.approx(np.linalg.norm(turn_deg), abs=0.05)


def test_three_degrees_are_an_error(rooms: Path) -> None:
    status = watched(rooms, with_upper_rotated(read_rig(rooms / "rig.toml"), (0.0, 3.0, 0.0)))[0].status()
    assert status.level == 2 and status.message.startswith("broken: ")


def test_who_stands_still_is_told_nothing(true: tuple[RigMonitor, Kept]) -> None:
    status = fed(true, true[1][:1] * 100).status()
    assert (status.level, status.values) == (0, {"new_views": "1", "needed_views": str(PAIRS)})
    assert status.message.startswith("not looked yet")


def test_few_places_seen_again_and_again_are_no_verdict(true: tuple[RigMonitor, Kept]) -> None:
    places = true[1][::3]
    assert fed(true, places[:MIN_PLACES - 1] * 8).finding is None
    found = fed(true, places[:MIN_PLACES] * 6).finding
    assert found is not None and found.verdict == "good" and found.tried <= MIN_PLACES * POINTS


def test_it_looks_no_more_often_than_it_is_told_to(true: tuple[RigMonitor, Kept]) -> None:
    assert fed(true, true[1], every_s=LOOK_S + 1).status().values["new_views"] == str(len(true[1]) // 2)
    back = fed(true, true[1][:4])
    back.process(replace(true[1][9], stamp_ns=1))  # a clock that was set back does not silence it
    assert back.status().values["new_views"] == "5"


def test_a_rig_that_was_knocked_on_the_way_is_noticed(rooms: Path, true: tuple[RigMonitor, Kept]) -> None:
    _, after = watched(rooms, with_upper_rotated(read_rig(rooms / "rig.toml"), (0.0, 0.0, 0.5)))
    watch = fed(true, [*true[1], *after, *after])  # on the same round, where every place has been seen
    assert watch.finding is not None and watch.status().level == 1
    assert watch.finding.turn_deg == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("gain", "noise"), [(0.0, 0.0), (0.0, 2.0), (0.0, 6.0), (0.02, 12.0)])
def test_the_dark_is_no_alarm(true: tuple[RigMonitor, Kept], gain: float, noise: float) -> None:
    """Lights go out on the way: noise makes points that match nowhere."""
    rng = np.random.default_rng(4)

    def dark(one: Panoramas) -> Panoramas:
        images = [np.clip(w.image * gain + 8 + noise * rng.standard_normal(w.image.shape), 0, 255).astype(np.uint8)
                  for w in (one.lower, one.upper)]
        return replace(one, lower=replace(one.lower, image=images[0]), upper=replace(one.upper, image=images[1]))

    status = fed(true, [dark(one) for one in true[1]]).status()
    assert status.level == 0, status


def test_a_covered_camera_is_an_error(true: tuple[RigMonitor, Kept]) -> None:
    covered = [replace(one, upper=replace(one.upper, image=np.full_like(one.upper.image, 9))) for one in true[1]]
    status = fed(true, covered).status()
    assert status.level == 2 and "covered" in status.message
