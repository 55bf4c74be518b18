"""Programs of a batch are ended where they take too long."""

from __future__ import annotations

from pathlib import Path

from omnid.batch.job_runner import run_job
from omnid.batch.jobs import BatchOptions, find_logs, jobs
from tests.omnid.batch.test_job_runner import SAMPLE


def test_a_log_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    (job,) = jobs(find_logs([str(SAMPLE)]), tmp_path, BatchOptions(timeout_s=0.3))
    assert run_job(job).status == "timed out"
