"""Workers on dask: one that is killed costs repetition only."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.batch.job_runner import KILLED, OK, JobTask
from omnid.batch.jobs import BatchOptions, jobs
from omnid.batch.workers import dask_workers
from tests.omnid.batch.dask_cluster import dask_cluster
from tests.omnid.batch.test_job_runner import BYTES, short_log


@pytest.mark.slow
def test_a_dask_worker_that_is_killed_costs_nothing_but_repetition(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    logs = [short_log(tmp_path / "logs" / f"{number}.mcap", BYTES + 1000 * number) for number in range(8)]
    with dask_cluster(tmp_path) as (address, workers):
        results = []
        tasks = [JobTask(job) for job in jobs([str(log) for log in logs], tmp_path / "out", BatchOptions())]
        with dask_workers(address) as run:
            for result in run(tasks):
                results.append(result)
                if len(results) == 1:
                    workers[0].kill()
    assert sorted(result.name for result in results) == sorted(log.stem for log in logs)
    assert {result.status for result in results} == {OK} and KILLED not in results
