"""Time of the first start, which compiles all functions: `python -m tests.benchmark.first_start`.

The first row is a program with an empty cache, as a user waits for it. The others are the processor times of the
functions, which one program compiles one after the other; what an earlier function has called is not counted again.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import time
from tempfile import TemporaryDirectory

import numba

from omnid.core.compiled import declared
from omnid.engine import kernel_store
from omnid.engine.python_program import python, python_environment
from tests.benchmark.results import Column, ResultTable

PREPARE = "from omnid.engine.kernel_cache import prepare_kernels; prepare_kernels(lambda _level, _text: None)"


def first_start() -> tuple[float, float, float]:
    """Return time [s], processor time [s] and the largest process [MB] of a program with an empty cache."""
    with TemporaryDirectory() as cache:
        started_s = time.monotonic()
        subprocess.run(python("-c", PREPARE), env=python_environment(OMNID_CACHE_DIR=cache), check=True)
        took_s = time.monotonic() - started_s
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return took_s, children.ru_utime + children.ru_stime, children.ru_maxrss / 1024


def main() -> None:
    """Print a row for the start, and one for each function."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    columns = (
        Column("what"),
        Column("time", "s", 1),
        Column("processor time", "s", 1),
        Column("largest process", "MB", 0),
    )
    table = ResultTable("first_start", "speed", "First start: compilation of all functions", columns)
    table.add(f"start with an empty cache, {len(os.sched_getaffinity(0))} cores", *first_start())
    for name in kernel_store.kernel_files():
        kernel_store.functions_of(name)
    numba.njit("(f8,)")(lambda x: x)  # what the first compilation of all loads is no part of a function's time
    for kernel in tuple(declared()):
        before_s = time.process_time()
        kernel.load(kernel.code())
        table.add(f"{kernel.function.__module__}.{kernel.__name__}", None, time.process_time() - before_s, None)


if __name__ == "__main__":
    main()
