"""Points of the cloud that lie in free cells of the map, and the height of the cameras that the floor shows.

    python -m tests.bench.free_cells LOG ...

LOG is a folder with log.mcap, truth.txt and rig.toml or camchain.yaml, whose world has its floor at z = 0, as those of
`python -m tests.simulation NAME --seed N`; `omnid/sample` is one, whose log has the rig. Each log is replayed twice:
with the true height of the cameras in its rig, and with none. The grid is that of `omnid map export --grid`, the points
are those of `omnid replay --cloud` whose true heights lie between 0.1 m and the robot's top (obstacles.ring.heights_m).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.kalibr import import_chain
from calib.rig import Rig
from calib.rig_file import read_rig
from drivers.logs.log_reader import LogReader
from omnid.config import Config
from omnid.core.floor import Floor
from omnid.core.mapping.scan_grid import FREE, OCCUPIED, UNKNOWN, Grid
from omnid.core.places.place_views import grid
from omnid.engine.telemetry import Telemetry
from omnid.formats.tum import read_tum
from omnid.messages import OdometryUpdate
from omnid.runs.replay import ReplayOptions, run_log
from omnid.runs.session import attached_rig
from omnid.sinks.encoder import Outgoing
from omnid.stages.front_end import FrontEnd
from omnid.stages.obstacles import CameraFloor
from tests.bench.results import Cell, Column, ResultTable

Array = NDArray[np.float64]
CELL_M = 0.05
COLUMNS = (
    Column("log"),
    Column("height of the cameras"),
    Column("found - true", "cm", 1),
    Column("sigma", "cm", 1),
    Column("tilt", "deg", 2),
    Column("points"),
    Column("in free cells", "%", 2),
    Column("in occupied cells", "%", 1),
    Column("in unknown cells", "%", 1),
    Column("free cells"),
)


class FloorOfKeyframes:
    """The floor by the keyframes of a run, as its map sees it."""

    def __init__(self, front_end: FrontEnd, config: Config) -> None:
        self._dense = front_end.dense
        self.camera_floor = CameraFloor(front_end.geometry.rig, config.obstacles.ring.floor_m)

    def process(self, message: Outgoing) -> None:
        """Add a keyframe."""
        if isinstance(message, OdometryUpdate) and message.is_keyframe:
            self.camera_floor.add(self._dense.of(message.depth))


class Shares(NamedTuple):
    """Points, and those in free, occupied and unknown cells."""

    points: int
    free: int
    occupied: int
    unknown: int


def shares(drawn: Grid, xy: Array) -> Shares:
    """Return where points (N, 2) [m] lie in a grid; what is outside is unknown."""
    column, row = np.floor((xy - drawn.corner) / drawn.cell_m).astype(int).T
    height, width = drawn.cells.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    values = np.where(inside, drawn.cells[np.where(inside, row, 0), np.where(inside, column, 0)], UNKNOWN)
    return Shares(len(xy), *(int((values == kind).sum()) for kind in (FREE, OCCUPIED, UNKNOWN)))


def measure(folder: Path) -> Iterator[list[Cell]]:
    """Yield the rows of a log."""
    truth = read_tum(folder / "truth.txt")
    height_m = float(np.median(truth.T[:, 2, 3]))
    unstated = replace(rig_of(folder), T_base_rig=np.eye(4))
    for name, rig in (("stated", unstated.at_height(height_m)), ("not stated", unstated)):
        yield [folder.name, name, *_row(folder, rig, truth.T[0], height_m)]


def _row(folder: Path, rig: Rig, T_world_odom: Array, height_m: float) -> list[Cell]:
    config = Config()
    seen: list[FloorOfKeyframes] = []

    def observer(front_end: FrontEnd, _: Telemetry) -> FloorOfKeyframes:
        seen.append(FloorOfKeyframes(front_end, config))
        return seen[0]

    result = run_log(
        folder / "log.mcap", config, ReplayOptions(rig=rig, inline=True, build=True, collect=True, observer=observer)
    )
    assert result.map is not None and result.rig_places is not None
    points = result.map.xyz.astype(float)
    above = se3.apply(T_world_odom, points)[:, 2]
    low, high = config.obstacles.ring.heights_m
    standing = se3.apply(rig.T_base_rig, points[(above > low) & (above < high)])
    drawn = grid(result.rig_places.places, result.rig_places.rig, CELL_M)
    found = shares(drawn, standing[:, :2])
    floor = seen[0].camera_floor.floor or Floor(np.nan, np.nan, np.nan, np.nan)
    estimate = (
        [np.nan] * 3
        if rig.height_m()
        else [100 * (floor.height_m - height_m), 100 * floor.sigma_m, np.degrees(floor.tilt_rad)]
    )
    return [
        *estimate,
        found.points,
        *(100 * n / max(1, found.points) for n in found[1:]),
        int((drawn.cells == FREE).sum()),
    ]


def rig_of(folder: Path) -> Rig:
    """Return the rig in a folder, or else that of its log."""
    if (folder / "rig.toml").exists():
        return read_rig(folder / "rig.toml")
    if (folder / "camchain.yaml").exists():
        return import_chain(folder / "camchain.yaml")
    reader = LogReader(folder / "log.mcap")
    try:
        return attached_rig(reader, folder / "log.mcap")
    finally:
        reader.close()


def main() -> None:
    """Print the table of all logs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    arguments = parser.parse_args()
    table = ResultTable(
        "free_cells",
        "Points of the cloud in free cells of the map",
        COLUMNS,
        (
            "Points whose true height is between 0.1 m and the robot's top; at most 1 % of them may lie in free cells. "
            "Of `two_walls` (768 px) and `sample` (the same drive at 512 px) the renderer is POV-Ray. The floor's "
            "noise and the grid were fitted on the sample, rooms 601 and 602, and two_walls 601 and 602; for this "
            "table only those of 603 and 604 are validation.",
        ),
    )
    for folder in arguments.logs:
        for row in measure(folder):
            table.add(*row, folder=folder)


if __name__ == "__main__":
    main()
