"""`omnid batch` on short real logs: results, resumption, killed programs, interruption, tables, addresses."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.logs.mcap_index import read_attachments, read_summary
from drivers.logs.mcap_records import LogFile
from omnid.batch.job_runner import OK, run_job, stored_result
from omnid.batch.jobs import BatchOptions, find_logs, jobs
from omnid.cli import main
from omnid.errors import OmnidError
from tests.waiting import wait_until

SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))
BYTES = 450_000  # of the sample: some pairs and the rig that is attached
DEADLINE_S = 60.0


def short_log(path: Path, count: int = BYTES) -> Path:
    """The start of the sample: a recording that was cut, but one with poses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with SAMPLE.open("rb") as sample:
        path.write_bytes(sample.read(count))
    return path


def omnid(*words: object) -> subprocess.CompletedProcess[str]:
    """Run a command in this process; the programs that it starts are others."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([*map(str, words)])
        except SystemExit as ended:
            code = int(ended.code or 0)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


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


def is_pending(process: int, number: signal.Signals) -> bool:
    """Return whether a signal waits for a process that is stopped."""
    (line,) = (line for line in Path(f"/proc/{process}/status").read_text().splitlines() if line.startswith("ShdPnd:"))
    return bool(int(line.split()[1], 16) >> (number - 1) & 1)


def test_results_are_those_of_single_runs_and_a_bad_log_stops_nothing(tmp_path: Path) -> None:
    """Also where a truth lies beside the log, here the trajectory of the single run."""
    good, out = short_log(tmp_path / "logs" / "day1" / "log.mcap"), tmp_path / "out"
    (tmp_path / "logs" / "broken.mcap").write_text("no log")
    single = omnid(
        "replay",
        good,
        "--tum",
        tmp_path / "est.txt",
        "--cloud",
        tmp_path / "cloud.ply",
        "--plan",
        tmp_path / "plan.png",
        "--quiet",
    )
    assert single.returncode == 0
    shutil.copy(tmp_path / "est.txt", good.parent / "truth.txt")
    done = omnid("batch", tmp_path / "logs", "--out", out, "--jobs", 2)
    assert done.returncode == 1 and "1 failed, 1 ok" in done.stdout, done.stderr
    for name in ("est.txt", "cloud.ply", "plan.png"):
        assert (out / "day1-log" / name).read_bytes() == (tmp_path / name).read_bytes()
    found = rows(out)
    assert [found[name]["status"] for name in ("broken", "day1-log")] == ["failed", "ok"]
    assert "is not an MCAP log" in found["broken"]["error"] and int(found["day1-log"]["pairs"]) >= 3
    assert float(found["day1-log"]["ate_rmse_m"]) == float(found["day1-log"]["length_error_ratio"]) == 0.0
    assert "day1-log/plan.png" in (out / "index.html").read_text()

    # What is done is not done again; what failed is; a changed option changes all results.
    before = (out / "day1-log" / "result.json").stat().st_mtime_ns
    short_log(tmp_path / "logs" / "broken.mcap")
    again = omnid("batch", tmp_path / "logs", "--out", out)
    assert again.returncode == 0 and "1 of 2 logs have their results already" in again.stderr, again.stderr
    assert (out / "day1-log" / "result.json").stat().st_mtime_ns == before
    assert rows(out)["broken"]["status"] == "ok" and rows(out)["broken"]["ate_rmse_m"] == "", "no truth lies beside it"
    (changed,) = [
        job
        for job in jobs(
            find_logs([str(tmp_path / "logs")]), out, BatchOptions(("--set", "odometry.limits.features=300"))
        )
        if job.log == str(good)
    ]
    assert stored_result(changed) is None


def test_results_of_another_rig_are_old(tmp_path: Path) -> None:
    log, rig, out = short_log(tmp_path / "log.mcap"), tmp_path / "rig.toml", tmp_path / "out"
    file = LogFile(log)
    rig.write_bytes(bytes(read_attachments(file, read_summary(file))["rig.toml"]))
    file.close()
    words = "batch", log, "--out", out, "--rig", rig
    assert omnid(*words).returncode == 0
    assert "1 of 1 logs have their results already" in omnid(*words).stderr
    rig.write_text("no rig any more")
    again = omnid(*words)
    assert again.returncode == 1 and "1 failed" in again.stdout and "already" not in again.stderr


def test_a_job_whose_program_is_killed_is_run_again(tmp_path: Path) -> None:
    log, out = short_log(tmp_path / "log.mcap", 2 * BYTES), tmp_path / "out"
    with subprocess.Popen(
        [sys.executable, "-m", "omnid", "batch", str(log), "--out", str(out)],
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as batch:
        wait_until(lambda: bool(replays_of(log)))
        os.kill(replays_of(log)[0], signal.SIGKILL)
        text, messages = batch.communicate(timeout=DEADLINE_S)
    assert batch.returncode == 0 and "1 ok" in text, messages
    assert rows(out)["log"]["attempts"] == "2"


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_an_interrupted_batch_leaves_no_program_and_goes_on_later(
    tmp_path: Path, number: signal.Signals, default_signals: None
) -> None:
    log, out = short_log(tmp_path / "log.mcap", 2 * BYTES), tmp_path / "out"
    with subprocess.Popen(
        [sys.executable, "-m", "omnid", "batch", str(log), "--out", str(out)],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as batch:
        wait_until(lambda: bool(replays_of(log)))
        # The replay stands until the batch has told it to end: on a busy machine it would be over before.
        (replay,) = replays_of(log)
        os.kill(replay, signal.SIGSTOP)
        second = omnid("batch", log, "--out", out)
        assert second.returncode == 2 and "another batch writes into" in second.stderr
        batch.send_signal(number)
        wait_until(lambda: is_pending(replay, signal.SIGTERM))
        os.kill(replay, signal.SIGCONT)
        batch.communicate(timeout=DEADLINE_S)
    assert batch.returncode == 130
    wait_until(lambda: not replays_of(log))
    assert not (out / "log").exists()
    assert omnid("batch", log, "--out", out).returncode == 0
    assert (
        sorted(path.name for path in out.iterdir()) == [".lock", "index.html", "log", "results.csv"]
        or (out / "results.parquet").exists()
    )


def test_reads_logs_at_addresses(tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    log = short_log(tmp_path / "logs" / "log.mcap")
    assert find_logs([f"file://{tmp_path}/logs/*.mcap"]) == [f"file://{log}"]
    (job,) = jobs([f"file://{log}"], tmp_path / "out", BatchOptions())
    result = run_job(job)
    assert result.status == OK and not list(job.folder.glob("*.mcap"))
    with pytest.raises(OmnidError, match="nothing at"):
        find_logs([f"file://{tmp_path}/logs/*.bag"])


def test_names_that_are_no_text_are_escaped_everywhere(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for name in (b"\xff\x1b[2J\n.mcap", b"...mcap"):
        Path(os.fsdecode(os.fsencode(logs) + b"/" + name)).write_text("no log")
    done = omnid("batch", logs, "--out", tmp_path / "out")
    assert done.returncode == 1 and "2 failed" in done.stdout and "Traceback" not in done.stderr, done.stderr
    found = rows(tmp_path / "out")
    assert found.keys() == {"'-2J-", "log"} and found["'-2J-"]["log"] == rf"{logs}/\xff\x1b[2J\n.mcap"
    table, page = ((tmp_path / "out" / name).read_text() for name in ("results.csv", "index.html"))
    assert len(table.splitlines()) == 3 and not any("\x1b" in text for text in (done.stdout, done.stderr, table, page))


def test_a_stored_result_of_another_version_or_with_damage_is_none(tmp_path: Path) -> None:
    log = short_log(tmp_path / "log.mcap", 1000)
    (job,) = jobs(find_logs([str(log)]), tmp_path / "out", BatchOptions())
    job.folder.mkdir(parents=True)
    path = job.folder / "result.json"
    for text in ("", "{", "[]", json.dumps({"name": 1}), json.dumps({"name": "log", "log": "x", "status": OK})):
        path.write_text(text)
        assert stored_result(job) is None
    path.write_text(json.dumps({"name": "log", "log": "x", "status": OK, "key": job.key()}))
    assert stored_result(job) is not None
    os.utime(log, (1, 1))
    assert stored_result(job) is None


def test_wrong_options_are_one_line(tmp_path: Path) -> None:
    times = [("--timeout-s", seconds) for seconds in ("inf", "nan", "0", "1e7")]
    for words in (("--jobs", 0), ("--set", "no.such=1"), ("--dask", "tcp://127.0.0.1:1"), *times):
        done = omnid("batch", SAMPLE, "--out", tmp_path / "out", *words)
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
    done = omnid("batch", SAMPLE, "--out", Path(__file__))
    assert done.returncode == 2 and "expected a folder for the results, found a file" in done.stderr
