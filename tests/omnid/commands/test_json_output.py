"""`--json` of the commands that have results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.replay.command import Command

FEW = 8  # pairs of a replay of 0.75 s


def loaded(omnid: Command, *words: object, code: int = 0) -> Any:
    done = omnid(*words, "--json")
    assert done.code == code, done.err
    return json.loads(done.out)


def test_results_of_a_replay_as_json(omnid: Command, scene: Path, tmp_path: Path) -> None:
    tum, a = tmp_path / "est.txt", tmp_path / "a.mcap"
    words = ("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", "--inline", "--seconds", 0.75)
    first = loaded(omnid, *words, "--tum", tum, "--record", a)
    assert first["counters"]["poses"] == FEW and first["counters"]["states"]["tracking"] == FEW
    assert first["timings"]["odometry"]["n"] == FEW and first["signal"] == 0 and len(first["warnings"]) == 1
    assert 0 < first["elapsed_s"] < 600
    metrics = loaded(omnid, "eval", tum, scene / "truth.txt")
    assert metrics["pairs"] == FEW and 0 < metrics["ate_rmse_m"] < 0.05
    info = loaded(omnid, "log", "info", scene / "log.mcap", a)
    assert [entry["path"] for entry in info] == [str(scene / "log.mcap"), str(a)]
    assert info[1]["topics"]["/omnid/odom"] == ["nav_msgs/msg/Odometry", FEW]


def test_numbers_that_are_not_finite_are_null(omnid: Command, tmp_path: Path) -> None:
    still = tmp_path / "still.txt"
    still.write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    assert loaded(omnid, "eval", still, still)["length_error_ratio"] is None


def test_findings_of_the_doctor_as_json(omnid: Command) -> None:
    findings = loaded(omnid, "doctor", "--set", "cameras.lower=/dev/none", "--set", "cameras.upper=/dev/none", code=1)
    assert {"level", "subject", "found", "advice"} == set(findings[0])
    assert any(entry["level"] == "error" for entry in findings)
