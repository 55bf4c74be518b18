"""Workers on dask: one that is killed costs repetition only."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from omnid.batch.job_runner import KILLED, OK, JobTask
from omnid.batch.jobs import BatchOptions, jobs
from omnid.batch.workers import dask_workers
from tests.omnid.batch.test_job_runner import BYTES, short_log, wait_until


@pytest.mark.slow
def test_a_dask_worker_that_is_killed_costs_nothing_but_repetition(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    logs = [short_log(tmp_path / "logs" / f"{number}.mcap", BYTES + 1000 * number) for number in range(8)]
    scheduler = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "distributed.cli.dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--scheduler-file",
            str(tmp_path / "scheduler"),
        ]
    )
    workers = []
    try:
        wait_until((tmp_path / "scheduler").exists)
        address = json.loads((tmp_path / "scheduler").read_text())["address"]
        workers = [
            subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "distributed.cli.dask_worker",
                    address,
                    "--nthreads",
                    "1",
                    "--no-dashboard",
                    "--no-nanny",
                    "--local-directory",
                    str(tmp_path),
                ]
            )
            for _ in range(2)
        ]
        results = []
        tasks = [JobTask(job) for job in jobs([str(log) for log in logs], tmp_path / "out", BatchOptions())]
        with dask_workers(address) as run:
            for result in run(tasks):
                results.append(result)
                if len(results) == 1:
                    workers[0].kill()
        assert sorted(result.name for result in results) == sorted(log.stem for log in logs)
        assert {result.status for result in results} == {OK} and KILLED not in results
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()
