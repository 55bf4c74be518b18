"""`omnid accept` on trajectories: what to do, errors, page, JSON, times by keys, refusals."""

from __future__ import annotations

import io
import json
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from drivers.logs.mcap_index import read_attachments, read_summary
from drivers.logs.mcap_records import LogFile
from omnid.cli import main
from omnid.formats.tum import tum_row
from tests.omnid.recordings.test_acceptance import DISTANCE_M, drive


def written(folder: Path, scale: float = 1.0) -> Path:
    path = drive(scale=scale)
    rows = [tum_row(int(stamp_ns), T) for stamp_ns, T in zip(path.stamps_ns, path.T, strict=True)]
    (folder / "est.txt").write_text("\n".join(rows) + "\n")
    return folder / "est.txt"


def accept(*words: object) -> int:
    return main(["accept", *map(str, words)])


def test_without_a_log_it_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert accept() == 0
    assert "A B A B A B A" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--distance-m", "12", "--marks", "12.5", "60", "110", "est.tum"), "--distance-m and --marks"),
        (("-o", "accept.html"), "-o"),
        (("--json",), "--json"),
    ],
)
def test_options_of_a_drive_without_a_log_are_one_line(
    words: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert accept(*words) == 2
    out, error = capsys.readouterr()
    assert f"expected a log or a trajectory with {named}, found none; name it first" in error
    assert out == "" and error.count("\n") == 1


def test_an_accepted_drive_and_its_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "accept.html"
    assert accept(written(tmp_path), "--distance-m", DISTANCE_M, "-o", page) == 0
    text = capsys.readouterr().out
    assert "0.00 % (spread 0.00 %)" in text and "over 3 rounds" in text
    assert text.endswith("accepted: within 0.5 %\n")
    html = page.read_text()
    assert "Acceptance drive: Accepted" in html and html.count("<tr>") == 4 and "<svg" in html


def test_a_trajectory_may_be_a_tum_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path).rename(tmp_path / "est.tum")
    assert accept(path, "--distance-m", DISTANCE_M) == 0
    assert "over 3 rounds" in capsys.readouterr().out


def test_a_drive_that_is_too_long_is_not_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "accept.html"
    assert accept(written(tmp_path, 1.02), "--distance-m", DISTANCE_M, "--json", "-o", page) == 1
    found = json.loads(capsys.readouterr().out)
    assert not found["accepted"] and found["faults"][0].startswith("lengths are off by +2.00 %")
    rounds = found["drives"]["odometry"]["rounds"]
    assert len(rounds) == 3 and rounds[0]["there_m"] == pytest.approx(1.02 * DISTANCE_M, abs=0.01)
    assert "Not accepted" in page.read_text()


def test_the_page_draws_the_same_points_of_the_map_whichever_point_of_the_robot_counts(tmp_path: Path) -> None:
    """The base of the sample is on the floor, 1.2 m below its rig."""
    log, rig, page = tmp_path / "log.mcap", tmp_path / "rig.toml", tmp_path / "accept.html"
    log.write_bytes((files("omnid.sample") / "log.mcap").read_bytes()[:450_000])  # some pairs and the rig
    file = LogFile(log)
    rig.write_bytes(bytes(read_attachments(file, read_summary(file))["rig.toml"]))
    file.close()
    drawn = []
    for words in ((), ("--rig", rig)):
        assert accept(log, *words, "--distance-m", 1, "--marks", 0, 0.1, 0.2, "-o", page) == 1
        drawn += re.findall(r"Grey: (\d+) of the map's (\d+) points", page.read_text())
    assert len(drawn) == 2 and drawn[0] == drawn[1] and 0 < int(drawn[0][0]) < int(drawn[0][1])


def test_times_of_keys_are_unix_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = drive()
    at = np.array([2.0, 30.0, 58.0])
    keys = tmp_path / "marks.txt"
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n\n"))
    assert accept("--keys", keys) == 0
    assert len(keys.read_text().split()) == 3 and f"--marks {keys}" in capsys.readouterr().out
    keys.write_text("\n".join(f"{path.stamps_ns[0] * 1e-9 + t_s:.3f}" for t_s in at))
    estimate = written(tmp_path)
    assert accept(estimate, "--distance-m", DISTANCE_M, "--marks", keys, "--json") == 0
    by_file = json.loads(capsys.readouterr().out)["drives"]["odometry"]["visits"]
    assert accept(estimate, "--distance-m", DISTANCE_M, "--marks", *at, "--json") == 0
    by_times = json.loads(capsys.readouterr().out)["drives"]["odometry"]["visits"]
    assert [visit["mark"] for visit in by_file] == ["A", "B", "A"]
    assert [visit["x_m"] for visit in by_file] == pytest.approx([visit["x_m"] for visit in by_times], abs=1e-3)


def test_marks_already_taken_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = tmp_path / "marks.txt"
    keys.touch()
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n"))
    assert accept("--keys", keys) == 0
    taken = keys.read_text()
    assert accept("--keys", keys) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert keys.read_text() == taken and f"--keys {keys}: expected a new file" in error and "another name" in error


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), "expected the distance of the marks"),
        (("--distance-m", "12", "--marks", "soon"), "--marks soon: cannot be read"),
        (("--distance-m", "12", "--marks", "1", "later", "3"), "expected times in seconds, found 'later'"),
        (("--distance-m", "12", "--within-percent", "0"), "--within-percent 0"),
        (("--distance-m", "5"), "check --distance-m"),
        (("--keys", "marks.txt"), "expected no log beside it"),
    ],
)
def test_mistakes_are_one_line(
    words: tuple[str, ...], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert accept(written(tmp_path), *words) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1
