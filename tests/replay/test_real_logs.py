"""Accuracy on the logs beside the repository; skipped if they do not exist."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import Metrics, evaluate
from tests.replay.command import Command

DATA = Path(__file__).parents[3] / "shared" / "data"


def measured(omnid: Command, folder: Path, name: str, *words: object) -> Metrics:
    """Return the errors of the documented commands on a log."""
    source = DATA / name
    if not source.is_dir():
        pytest.skip(f"{source} does not exist")
    rig, tum = folder / "rig.toml", folder / "est.txt"
    assert omnid("calibrate", "import", source / "camchain.yaml", "-o", rig).code == 0
    result = omnid.replay(source / "log.mcap", "--tum", tum, "--cloud", folder / "map.ply", *words, rig=rig)
    assert result.code == 0, result.err
    return evaluate(read_tum(tum), read_tum(source / "truth.txt"))


def test_two_walls(omnid: Command, tmp_path: Path) -> None:
    found = measured(omnid, tmp_path, "two_walls")
    assert found.pairs == 99 and found.coverage >= 0.99
    assert abs(found.length_error_ratio) <= 0.0005
    assert found.ate_rmse_m <= 0.002 and found.end_error_m <= 0.003
    assert math.degrees(found.heading_max_rad) <= 0.05


def test_two_walls_misaligned(omnid: Command, tmp_path: Path) -> None:
    found = measured(omnid, tmp_path, "two_walls_crooked")
    assert found.coverage >= 0.99 and found.ate_rmse_m <= 0.004
    assert math.degrees(found.heading_max_rad) <= 0.1


def test_the_papers_method(omnid: Command, tmp_path: Path) -> None:
    """The first fifth of the log, a metre: its matching takes ten times as long as that of the other method."""
    found = measured(omnid, tmp_path, "two_walls", "--method", "paper", "--seconds", "2.05")
    assert found.pairs >= 20 and found.ate_rmse_m < 0.06
