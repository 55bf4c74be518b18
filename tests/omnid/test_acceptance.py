"""The example of the acceptance drive, on trajectories of rounds between two marks."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from omnid.formats.tum import tum_row
from tests.simulation.paths import planar_poses

STEP_NS, STAND, STEP_M, DISTANCE_M, NOISE_M = 10**8, 40, 0.05, 12.0, 1e-3


def write_rounds(path: Path, scales: tuple[float, ...], aside_m: float) -> None:
    """Write a trajectory of rounds, each with its own scale and end beside its start, and a pause half-way."""
    there = np.arange(0, DISTANCE_M + 1e-9, STEP_M)
    there = np.insert(there, len(there) // 2, [there[len(there) // 2]] * 50)
    round_m = np.concatenate([there, np.full(STAND, DISTANCE_M), there[::-1], np.zeros(STAND)])
    way_m = np.concatenate([np.zeros(STAND), *(scale * round_m for scale in scales)])
    y_m = aside_m * np.cumsum(np.abs(np.diff(way_m, prepend=0.0))) / (2 * DISTANCE_M)
    noise = NOISE_M * np.random.default_rng(1).standard_normal((len(way_m), 2))
    poses = planar_poses(np.column_stack([way_m, y_m]) + noise, np.zeros(len(way_m)))
    stamps_ns = 1_700_000_000 * 10**9 + STEP_NS * np.arange(len(way_m))
    path.write_text("\n".join(tum_row(int(stamp), T) for stamp, T in zip(stamps_ns, poses, strict=True)))


@pytest.mark.parametrize(
    ("scales", "aside_m", "code", "longest"),
    [
        ((1.0, 1.0, 1.0), 0.0, 0, "+0.0"),
        ((1.02, 1.02), 0.0, 1, "+2.0"),
        ((1.02, 0.98), 0.0, 1, "+2.0"),  # right in the mean only
        ((1.0, 1.0, 1.0), 0.3, 1, "+0.0"),  # ends beside its start
    ],
)
def test_errors_of_rounds(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    scales: tuple[float, ...],
    aside_m: float,
    code: int,
    longest: str,
) -> None:
    path = tmp_path / "est.txt"
    write_rounds(path, scales, aside_m)
    monkeypatch.setattr("sys.argv", ["acceptance", str(path), str(DISTANCE_M)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("omnid.examples.acceptance", run_name="__main__")
    out = capsys.readouterr().out
    assert ended.value.code == code, out
    assert out.count("round of ") == len(scales) and out.count(" to ") == 2 * len(scales)
    errors = re.findall(r"m, ([+-]\d+\.\d)", out)
    assert max(errors, key=float).startswith(longest), out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["est.txt", "3.0"], "on B 3 m away"),
        (["missing.mcap", "3.0"], "cannot read the log 'missing.mcap'"),
        (["est.txt", "three"], "could not convert"),
        ([], "expected LOG DISTANCE_M"),
    ],
)
def test_what_cannot_be_judged_is_one_line_and_no_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: list[str], line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_rounds(tmp_path / "est.txt", (1.0,), 0.0)
    monkeypatch.setattr("sys.argv", ["acceptance", *words])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("omnid.examples.acceptance", run_name="__main__")
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1
