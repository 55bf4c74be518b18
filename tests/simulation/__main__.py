"""`python -m tests.simulation NAME --seed N --out DIR [--size 768] [--pairs N]` renders a log with ground truth.

--speed: factor on the speed; at 1 two_walls has 0.5 m/s, rooms about 0.57 m/s and 36 deg/s. Cameras that are not
synchronised: `--speed 1.4 --skew-ms 15`, or `--skew-ms 5 25` (upper minus lower exposure and stamp of the first and the
last pair). A rolling shutter of 20 ms on 768 rows:
`--line-time-us 26`, or that of lower and upper; a stamp is that of the first row. Real mirrors: `--mirrors 1` (tilted
cameras, mirrors off shape by 1.5 %), with nominal.toml instead of rig.toml. Real lenses, lamps and electronics:
`--real`, or some of `tests/simulation/disturbances.py` by `--disturb flicker dust`. Dim images with much noise, whose
brightness changes: `--dim`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calib.rig import ShutterTimes
from calib.rig_file import write_rig
from tests.bench.results import run
from tests.simulation.disturbances import DISTURBANCES, Disturbance
from tests.simulation.logs import Readout, write_log
from tests.simulation.recipes import DIM, build
from tests.simulation.rigs import nominal_rig, with_real_mirrors


def render(
    name: str,
    *,
    out: Path,
    seed: int = 1,
    size: int = 768,
    pairs: int = 0,
    mirrors: float = 0.0,
    speed: float = 1.0,
    skew_ms: Sequence[float] = (0.0,),
    line_time_us: Sequence[float] = (0.0,),
    dim: bool = False,
    disturb: Sequence[Disturbance] = (),
    real: bool = False,
) -> None:
    """Render one recipe into a folder."""
    made = build(name, seed, size, pairs or None)
    rig = with_real_mirrors(made.rig, seed, mirrors) if mirrors else made.rig
    readout = Readout(speed, (skew_ms[0], skew_ms[-1]), line_time_us=(line_time_us[0], line_time_us[-1]))
    write_log(
        out,
        rig,
        made.poses,
        made.scene,
        sensor=DIM if dim else made.sensor,
        seed=seed,
        supersample=3,
        readout=readout,
        disturbances=DISTURBANCES if real else tuple(disturb),
    )
    if any(line_time_us):
        known, name = (nominal_rig(rig), "nominal.toml") if mirrors else (rig, "rig.toml")
        write_rig(out / name, replace(known, times=ShutterTimes(0.0, 1e-6 * line_time_us[0])))


if __name__ == "__main__":
    run(render)
