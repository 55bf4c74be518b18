"""Drives as those of `obstacle_stops`, whose images POV-Ray traces: another renderer, with mirrors and real reflection.

`python -m tests.benchmark.traced_drives --seeds FIRST LAST [CASE ...]`; each image takes seconds, a drive half an hour
on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from functools import partial
from operator import is_
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.frame import Camera
from omnid.simulation.cameras import SimulatedCameras
from omnid.simulation.lockstep import Drive as Script
from omnid.simulation.lockstep import Moment, Request
from omnid.simulation.rendering.sensor import Floats, Sensor
from omnid.simulation.rendering.surfaces import Rectangle, Scene
from omnid.simulation.world import World
from tests.benchmark.obstacle_stops import Conditions, Drive, run
from tests.benchmark.results import Column, ResultTable
from tests.experiments.povray import shoot, write_world

Array = NDArray[np.float64]

CASES: Final = ("plain pole", "pole", "edge 15 cm", "edge 8 cm", "low box", "bar", "polished box", "polished free")
SPEEDS_MPS: Final = (0.8, 0.5)  # by turns
GLOSS: Final = 0.1  # share of the light that a polished floor mirrors: Fresnel's for n = 1.5 at 60 degrees
REST_S, REST_M = 2.0, 0.01  # a base that has moved less in this time is at rest, and the drive ends
SET_OUT_M: Final = 0.3


class TracedCameras(SimulatedCameras):
    """Cameras below curved mirrors, traced by POV-Ray; PovrayError: it is missing, or cannot trace them."""

    def __init__(self, rig: Rig, sensor: Sensor, world: World, seed: int, samples: int, *, folder: Path) -> None:
        """folder: where the scenes are written."""
        super().__init__(rig, sensor, world, seed, samples)
        self._folder, self._written = folder, tuple[Rectangle, ...]()
        self._gloss = GLOSS if world.is_polished else 0.0

    def ideal(self, camera: Camera, scene: Scene, T_world_rig: Array) -> Floats:
        """Return the image (H, W) of a scene, with what a polished floor mirrors of it."""
        if len(scene.rectangles) != len(self._written) or not all(map(is_, scene.rectangles, self._written)):
            write_world(self._folder, scene, self._gloss)
            self._written = scene.rectangles
        return shoot(self._folder, self._mounted[camera], T_world_rig, self._samples)


class UntilAtRest:
    """A script that ends once the robot has set out and stood for REST_S."""

    def __init__(self, script: Script) -> None:
        self._script, self._since_s = script, 0.0
        self._start: Array | None = None
        self._stood: Array | None = None

    def __call__(self, moment: Moment) -> Iterator[Request]:
        """Yield what the script asks for, and the end."""
        place = moment.T_world_base[:3, 3].copy()
        self._start = place if self._start is None else self._start
        if self._stood is None or np.linalg.norm(place - self._stood) > REST_M:
            self._stood, self._since_s = place, moment.time_s
        yield from self._script(moment)
        if np.linalg.norm(place - self._start) > SET_OUT_M and moment.time_s - self._since_s > REST_S:
            yield "end"


def traced(case: str, seed: int, speed_mps: float) -> Drive:
    """Return the result of one drive."""
    with tempfile.TemporaryDirectory() as folder:
        cameras = partial(TracedCameras, folder=Path(folder))
        return run(case, seed, Conditions(speed_mps), cameras=cameras, within=UntilAtRest)


def main() -> None:
    """Make the drives, print a line for each, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=CASES, metavar="CASE", help=f"default: {', '.join(CASES)}")
    parser.add_argument("--seeds", type=int, nargs=2, required=True, metavar=("FIRST", "LAST"))
    arguments = parser.parse_args()
    table = ResultTable(
        "obstacle_drives_traced",
        "obstacles",
        "Stops of the collision monitor, with images of another renderer",
        (
            Column("what stands in the way"),
            Column("seed"),
            Column("speed", "m/s", 1),
            Column("contacts"),
            Column("least clearance", "m", 2),
            Column("stops"),
            Column("false stops"),
            Column("driven", "m", 1),
            Column("why it stopped"),
        ),
        (
            "As the tables above, 512 px at 10 Hz, with images that POV-Ray traces: cameras above paraboloids. A "
            "polished floor mirrors a tenth of the light. A drive ends when the base has set out and stands for 2 s.",
        ),
    )
    for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
        for number, case in enumerate(arguments.cases):
            speed_mps = SPEEDS_MPS[(seed + number) % len(SPEEDS_MPS)]
            made = traced(case, seed, speed_mps)
            print(f"{case} {seed} {speed_mps:g} m/s: {made}", flush=True)
            clearance_m, driven_m = round(made.clearance_m, 3), round(made.driven_m, 2)
            stops = made.stops, made.false_stops
            table.rows.append([case, seed, speed_mps, made.contacts, clearance_m, *stops, driven_m, made.reasons])
            table.seeds = sorted({("obstacle stops", int(str(row[1]))) for row in table.rows})
            print(table.save())


if __name__ == "__main__":
    main()
