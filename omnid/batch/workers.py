"""Workers for the jobs: programs on this machine, or an existing scheduler of dask.distributed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from importlib import import_module
from typing import Any, Final

from omnid.batch.job_runner import FAILED, KILLED, JobResult, end_programs, run_job
from omnid.batch.jobs import Job
from omnid.errors import OmnidError
from omnid.plain_text import one_line

MAX_ATTEMPTS: Final = 2  # A job whose program was killed is attempted this often.
_CONNECT_S: Final = 10.0

Workers = Callable[[Sequence[Job]], Iterator[JobResult]]


def local_workers(count: int) -> Workers:
    """Return workers that run `count` jobs at a time; a job whose program was killed is run once more."""

    def run(jobs: Sequence[Job]) -> Iterator[JobResult]:
        # Threads only wait here: the work is done in programs of their own.
        with ThreadPoolExecutor(count) as pool:
            futures = [pool.submit(run_repeatedly, job) for job in jobs]
            try:
                for future in as_completed(futures):
                    yield future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
                end_programs()

    return run


def run_repeatedly(job: Job) -> JobResult:
    """Run a job, again where its program was killed; an error of the machine, such as a full disk, is its result."""
    result = JobResult(job.name, job.log)
    for attempt in range(1, MAX_ATTEMPTS + 1):
        try:
            result = replace(run_job(job), attempts=attempt)
        except OSError as error:
            result = JobResult(job.name, job.log, FAILED, one_line(error), attempts=attempt)
        if result.status != KILLED:
            break
    return result


def dask_workers(address: str) -> Workers:
    """Return the workers of a dask scheduler; raise OmnidError where none answers.

    They need omnid and the folders of logs and results at the same paths. Jobs of a worker that dies go to another.
    """
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise OmnidError(
            f"batch --dask needs dask.distributed: install the extra `fleet` of omnid into {sys.prefix}"
        ) from error
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OmnidError(
            f"batch: no dask scheduler answers at {address!r}: {one_line(error)}; start one with "
            "`dask scheduler`, and give its address such as tcp://HOST:8786"
        ) from error

    def run(jobs: Sequence[Job]) -> Iterator[JobResult]:
        with client:
            of_future = {client.submit(run_repeatedly, job, pure=False): job for job in jobs}
            for future in distributed.as_completed(of_future, loop=client.loop, raise_errors=False):
                if future.status == "finished":
                    yield future.result()
                else:
                    job = of_future[future]
                    yield JobResult(job.name, job.log, FAILED, one_line(future.exception()))

    return run
