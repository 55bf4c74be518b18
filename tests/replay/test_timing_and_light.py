"""Rendered drives of cameras that are not synchronised, of rolling shutters, and in dim light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import omnid
from calib.rig import ShutterTimes
from calib.rig_file import read_rig
from omnid.formats.tum import Trajectory, read_tum
from omnid.recordings.evaluation import Metrics, evaluate
from omnid.simulation.rendering.sensor import Sensor
from omnid.tracking_state import TrackingState
from tests.simulation import build, write_log
from tests.simulation.logs import Readout
from tests.simulation.recipes import DIM

SEED, SIZE, PAIRS = 3, 512, 24
LINE_TIME_US = 40.0  # 20 ms for 512 rows


def driven(folder: Path, readout: Readout | None = None, sensor: Sensor | None = None) -> Metrics:
    """Render the first metre of two_walls, and return the errors of a replay in which no pair was lost."""
    run = build("two_walls", SEED, SIZE, 99)
    write_log(
        folder,
        run.rig,
        run.poses[:PAIRS],
        run.scene,
        sensor=sensor or run.sensor,
        seed=SEED,
        supersample=2,
        readout=readout or Readout(),
    )
    times = ShutterTimes(0.0, 1e-6 * readout.line_time_us[0]) if readout else ShutterTimes()
    result = omnid.replay(folder / "log.mcap", replace(read_rig(folder / "rig.toml"), times=times))
    states = result.counters.states
    assert result.counters.pairs == PAIRS and states[TrackingState.LOST] == 0
    assert states[TrackingState.TRACKING] > 0.9 * PAIRS
    return evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))


@pytest.mark.slow
def test_the_motion_between_the_exposures_is_corrected(tmp_path: Path) -> None:
    speed = 1.4  # 0.7 m/s
    skew = driven(tmp_path / "skew", readout=Readout(speed, (15.0, 15.0)))
    assert abs(skew.length_error_ratio) < 0.0015 and skew.ate_rmse_m < 0.002
    rolling = Readout(speed, line_time_us=(LINE_TIME_US, LINE_TIME_US))
    known = driven(tmp_path / "known", readout=rolling)
    assert abs(known.length_error_ratio) < 0.0015 and known.ate_rmse_m < 0.002


@pytest.mark.slow
def test_dim_images_with_changing_brightness(tmp_path: Path) -> None:
    dim = driven(tmp_path / "dim", sensor=DIM)
    assert abs(dim.length_error_ratio) < 0.002 and dim.ate_rmse_m < 0.003
