"""The entry of the images' parts."""

from dataclasses import replace

import numpy as np

from omnid.config import Config
from omnid.core.stereo.tiles import ALL_LIVE, TILE_COLUMNS, TILE_ROWS, TileStates
from omnid.diagnostics.part_status import LIVE, ImagesStatus
from omnid.diagnostics.run_summary import RunStatistics
from omnid.messages import OdometryUpdate, StereoDepth
from omnid.simulation.robot import make_robot
from omnid.stages.geometry import geometry
from omnid.tracking_state import TrackingState
from omnid.transport.codec import ERROR, OK, STALE
from omnid.transport.status_names import lost_parts_key
from tests.omnid.small_pair import small_depth

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
