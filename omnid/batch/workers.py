"""Workers for tasks: programs on this machine, or an existing scheduler of dask.distributed."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from typing import Any, Final, Protocol, TypeVar

from omnid.batch.programs import end_programs
from omnid.errors import OmnidError
from omnid.plain_text import one_line

MAX_JOBS: Final = 256
_CONNECT_S: Final = 10.0

Result = TypeVar("Result")
ResultOf = TypeVar("ResultOf", covariant=True)


class Task(Protocol[ResultOf]):
    """Work for a worker; it can be pickled."""

    def run(self) -> ResultOf:
        """Run a program and return its result; raise BatchInterrupted where there is none."""

    def failed(self, error: str) -> ResultOf:
        """Return the result for a worker that was lost."""


class Workers(Protocol):
    """Runs tasks, and yields their results as they come."""

    def __call__(self, tasks: Sequence[Task[Result]], /) -> Iterator[Result]:
        """Yield the results, in any order."""


def workers_of(jobs: int, dask: str | None) -> AbstractContextManager[Workers]:
    """Return workers on this machine, `jobs` at a time, or those of the dask scheduler at an address."""
    if not 1 <= jobs <= MAX_JOBS:
        raise OmnidError(f"--jobs {jobs}: expected 1 to {MAX_JOBS}")
    return dask_workers(dask) if dask else local_workers(jobs)


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Give workers that run `count` programs at a time."""

    def run(tasks: Sequence[Task[Result]]) -> Iterator[Result]:
        # Each thread only waits for a program, which does the work.
        with ThreadPoolExecutor(count) as pool:
            futures = [pool.submit(task.run) for task in tasks]
            try:
                for future in as_completed(futures):
                    yield future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
                end_programs()

    yield run


@contextmanager
def dask_workers(address: str) -> Iterator[Workers]:
    """Give the workers of a dask scheduler; raise OmnidError where none answers.

    They need omnid and the folders of logs and results at the same paths. Tasks of a worker that dies go to another.
    """
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        raise OmnidError(
            f"--dask needs dask.distributed: install the extra `fleet` of omnid into {sys.prefix}"
        ) from error
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise OmnidError(
            f"no dask scheduler answers at {address!r}: {one_line(error)}; start one with "
            "`dask scheduler`, and give its address such as tcp://HOST:8786"
        ) from error

    def run(tasks: Sequence[Task[Result]]) -> Iterator[Result]:
        of_future = {client.submit(_run, task, pure=False): task for task in tasks}
        for future in distributed.as_completed(of_future, loop=client.loop, raise_errors=False):
            if future.status == "finished":
                yield future.result()
            else:
                yield of_future[future].failed(one_line(future.exception()))

    with client:
        yield run


def _run(task: Task[Result]) -> Result:
    return task.run()
