"""`omnid batch` on short real logs: results, resumption, killed programs, interruption, wrong input."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from importlib import import_module
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs dask.distributed")
SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))
BYTES = 450_000  # of the sample: some pairs and the rig that is attached
DEADLINE_S = 60.0


def short_log(path: Path, count: int = BYTES) -> Path:
    """The start of the sample: a recording that was cut, but one with poses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(SAMPLE.read_bytes()[:count])
    return path


def start(*words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "omnid", *map(str, words)]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def omnid(*words: object) -> tuple[int, str, str]:
    with start(*words) as program:
        out, err = program.communicate(timeout=DEADLINE_S)
    return program.returncode, out, err


def result(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return found


def replays_of(log: Path) -> list[int]:
    """The processes that replay a log."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"replay" in words and os.fsencode(log) in words:
            found.append(int(folder.name))
    return found


def test_results_are_those_of_single_runs_and_logs_are_replayed_once(tmp_path: Path) -> None:
    good, out = short_log(tmp_path / "logs" / "day1" / "log.mcap"), tmp_path / "out"
    (tmp_path / "logs" / "broken.mcap").write_text("no log")
    outputs = ("--tum", tmp_path / "est.txt", "--cloud", tmp_path / "cloud.ply", "--plan", tmp_path / "plan.png")
    assert omnid("replay", good, *outputs, "--quiet")[0] == 0
    shutil.copy(tmp_path / "est.txt", good.parent / "truth.txt")
    words = ("batch", tmp_path / "logs", "--out", out, "--jobs", 2)
    code, text, err = omnid(*words)
    assert (code == 1 and "1 ok, 1 failed" in text) or "1 failed, 1 ok" in text, err
    folder, broken = out / "day1" / "log.mcap", out / "broken.mcap"
    for name in ("est.txt", "cloud.ply", "plan.png"):
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes()
    found = result(folder)
    assert found["status"] == "ok" and found["replay"]["counters"]["pairs"] >= 3 and found["eval"]["ate_rmse_m"] == 0
    assert result(broken)["status"] == "failed" and "is no log" in result(broken)["error"]

    before_ns = (folder / "result.json").stat().st_mtime_ns
    short_log(tmp_path / "logs" / "broken.mcap")
    code, _, err = omnid(*words)
    assert code == 0 and "1 of 2 logs have their results already" in err, err
    assert (folder / "result.json").stat().st_mtime_ns == before_ns and "eval" not in result(broken)
    os.utime(good, (1, 1))
    code, _, err = omnid(*words, "--set", "odometry.limits.features=300")
    assert code == 0 and "already" not in err, "another file and other options: old results"


def test_a_program_that_is_killed_is_a_failure_and_an_interrupted_batch_leaves_none(tmp_path: Path) -> None:
    log, out = short_log(tmp_path / "log.mcap", 2 * BYTES), tmp_path / "out"
    with start("batch", log, "--out", out) as batch:
        wait_until(lambda: bool(replays_of(log)))
        listening = [at for at in import_module("psutil").Process(batch.pid).net_connections() if at.status == "LISTEN"]
        assert {at.laddr.ip for at in listening} <= {"127.0.0.1"}
        os.kill(replays_of(log)[0], signal.SIGKILL)
        _, err = batch.communicate(timeout=DEADLINE_S)
    assert batch.returncode == 1 and result(out / "log.mcap")["status"] == "failed", err
    assert err.count("\n") == 1 and err.startswith("1/1"), "one line a log, none of dask"
    with start("batch", log, "--out", out) as batch:
        wait_until(lambda: bool(replays_of(log)))
        batch.send_signal(signal.SIGTERM)
        batch.communicate(timeout=DEADLINE_S)
    assert batch.returncode == 130
    wait_until(lambda: not replays_of(log))
    assert not (out / "log.mcap" / "result.json").exists(), "what has failed is done again"
