"""Entries of the status of rig, floor and images, load shedding, and the summary of a run."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from calib.panorama import fit_cylinder
from omnid.config import Config
from omnid.core.rig.rig_health import RigHealth
from omnid.core.stereo.tiles import ALL_LIVE, TILE_COLUMNS, TILE_ROWS, TileStates
from omnid.diagnostics.load_ladder import PATIENCE, LoadLadder
from omnid.diagnostics.run_summary import RunCounters, RunStatistics, run_summary
from omnid.diagnostics.status import LIVE, ImagesStatus, floor_status, rig_status
from omnid.engine.telemetry import StageStats
from omnid.load_level import LoadLevel
from omnid.messages import OdometryUpdate, StereoDepth
from omnid.simulation.robot import make_robot
from omnid.stages.geometry import geometry
from omnid.stages.obstacles import CameraFloor
from omnid.tracking_state import TrackingState
from omnid.transport.codec import ERROR, OK, STALE, WARN
from omnid.transport.status_names import lost_parts_key
from tests.omnid.small_pair import small_depth
from tests.omnid.stages.test_keyframe_scan import depth
from tests.simulation.rigs import make_rig


@pytest.fixture
def health() -> RigHealth:
    return RigHealth(fit_cylinder(make_rig(size=256)), "warn", 5.0)


def test_a_rig_that_was_not_checked_says_what_to_do(health: RigHealth) -> None:
    status = rig_status(health)
    assert status.level == OK and status.message.startswith("not checked yet: the robot must drive")
    assert status.values == {"state": "unchecked", "new_views": "0", "needed_views": "16"}


def test_the_height_is_published_with_its_origin_and_warns_unless_it_is_stated() -> None:
    stated = floor_status(CameraFloor(make_rig().at_height(0.9), 0.0))
    assert stated.level == OK and stated.values == {"height_m": "0.9", "sigma_m": "0", "tilt_deg": "0"}
    camera_floor = CameraFloor(make_rig(), 0.0)
    unknown = floor_status(camera_floor)
    assert unknown.level == WARN and "nothing is free" in unknown.message and not unknown.values
    camera_floor.add(depth(np.eye(4)))
    found = floor_status(camera_floor)
    assert found.level == WARN and abs(float(found.values["height_m"]) - 1.2) < 0.03
    assert 0.005 < float(found.values["sigma_m"]) < 0.05


S = 1_000_000_000


def update(tiles: TileStates, stamp_ns: int) -> OdometryUpdate:
    """Return a pose whose pair has these tiles."""
    pair = small_depth(stamp_ns).panoramas
    return OdometryUpdate(
        0,
        stamp_ns,
        np.eye(4),
        np.eye(6),
        np.zeros(6),
        np.eye(6),
        TrackingState.TRACKING,
        0,
        9,
        9,
        StereoDepth(replace(pair, tiles=tiles)),
    )


def lost(first: int, last: int, *, is_dead: bool) -> TileStates:
    """Return tiles of which the upper camera has lost those columns since 100 s."""
    none = np.zeros((TILE_ROWS, TILE_COLUMNS), bool)
    tiles = none.copy()
    tiles[:, np.arange(first, last) % TILE_COLUMNS] = True
    dead, blind = (tiles, none) if is_dead else (none, tiles)
    return TileStates(
        {"lower": none, "upper": dead},
        {"lower": none, "upper": blind},
        {"lower": none.any(axis=0), "upper": tiles.any(axis=0)},
        {"lower": 0, "upper": 100 * S},
    )


def test_names_camera_directions_and_time_and_reports_changes_once() -> None:
    """Degrees count counter-clockwise from ahead, and columns from left to right."""
    statistics, lines = RunStatistics(), []  # type: ignore[var-annotated]
    status = ImagesStatus(geometry(make_robot(256).rig, Config().panorama), statistics, lines.append)
    assert status().level == STALE
    for number in range(2):
        statistics.process(update(lost(23, 40, is_dead=False), (112 + number) * S))
        entry = status()
    assert entry.level == ERROR and entry.values == {lost_parts_key("upper"): "13"}
    text = entry.message
    assert text.startswith("the upper camera is blind from ") and text.endswith(" degrees")
    begin, end = (int(word) for word in text.split() if word.isdigit())
    assert 298 <= begin <= 300 and 41 <= end <= 43
    statistics.process(update(lost(0, TILE_COLUMNS, is_dead=True), 114 * S))
    assert status().message == "the upper camera is frozen all around"
    statistics.process(update(ALL_LIVE, 115 * S))
    assert (status().level, status().message) == (OK, LIVE)
    assert lines == [f"images: {text}", "images: the upper camera is frozen all around", f"images: {LIVE}"]
    assert statistics.lost_parts == {"upper": 3}


class Observed:
    """A ladder, and the counters that it observes."""

    def __init__(self) -> None:
        self.ladder, self._stats = LoadLadder(), StageStats("pair")

    def level_after(self, count: int, *, dropped: int) -> int:
        """Return the level after so many observations, with so many of 60 images dropped in each."""
        for _ in range(count):
            self._stats.processed += 60 - dropped
            self._stats.dropped += dropped
            self.ladder.observe(self._stats)
        return self.ladder.level


def test_under_lasting_overload_everything_is_given_up_in_order() -> None:
    observed = Observed()
    assert observed.level_after(1, dropped=30) == 0
    assert [observed.level_after(1, dropped=30)] + [observed.level_after(2, dropped=30) for _ in range(4)] == [
        1,
        2,
        3,
        3,
        3,
    ]
    assert observed.ladder.level is LoadLevel.REDUCED


def test_it_waits_longer_each_time_that_was_too_soon() -> None:
    observed = Observed()
    waits = []
    for _ in range(8):
        observed.level_after(2, dropped=30)
        waits.append(next(k for k in range(1, 1000) if observed.level_after(1, dropped=0) == 0))
    assert waits[:3] == [PATIENCE[0], 2 * PATIENCE[0], 4 * PATIENCE[0]]
    assert waits[-1] == waits[-2] == PATIENCE[1]


def test_what_everybody_wants_to_know_comes_last_and_zeros_are_left_out() -> None:
    statistics = RunStatistics()
    statistics.poses, statistics.length_m, statistics.states = 98, 4.82741, Counter({"tracking": 98})
    brief = run_summary(RunCounters.of(statistics, 99, {"late": 0, "queue": 1}), []).splitlines()
    assert brief == [
        "poses     98 of 99 pairs of images",
        "lost      queue 1",
        "length    4.8274 m",
        "states    tracking 100.0%",
    ]
