"""Programs that compile one function of their own, so that a test takes a second."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omnid.engine import kernel_compiler

ROOT = Path(__file__).parents[3]


# One function of its own, so that a test takes a second: the files of core compile in conftest.py already.
PROGRAM = """
import logging, pathlib, sys
from omnid.engine import kernel_cache, kernel_compiler, kernel_store
import tests.omnid.engine.sample_kernels as sample
kernel_store.kernel_files = lambda: {sample.__name__: pathlib.Path(sample.__file__)}
if "deny" in sys.argv:
    import ctypes
    if ctypes.CDLL(None, use_errno=True).prctl(65, 1, 0, 0, 0) != 0:  # PR_SET_MDWE, PR_MDWE_REFUSE_EXEC_GAIN
        sys.exit(77)
if "impatient" in sys.argv:
    kernel_compiler.PATIENCE_S = 0.2
if "no-helpers" in sys.argv:
    kernel_compiler.python = lambda *words: [sys.executable, "-c", "raise SystemExit(1)"]
kernel_cache.prepare_kernels(lambda level, line: print(logging.getLevelName(level), line, flush=True))
import numpy as np
out = np.zeros(2)
sample.halves(np.array([3.0, 5.0]), out)
print(out.tolist(), int('numba' not in sys.modules))
"""


READ, COMPILED_HERE = (
    "[1.5, 2.5] 1",
    "[1.5, 2.5] 0",
)  # what the program prints where it reads code, and where it compiles


def started(cache: Path, *arguments: str, root: Path = ROOT) -> subprocess.Popen[str]:
    environment = os.environ | {"OMNID_CACHE_DIR": str(cache), "PYTHONPATH": str(root)}
    return subprocess.Popen(
        [sys.executable, "-P", "-c", PROGRAM, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=root,
    )


def run(cache: Path, *arguments: str, root: Path = ROOT) -> subprocess.CompletedProcess[str]:
    with started(cache, *arguments, root=root) as program:
        output, errors = program.communicate(timeout=300)
    return subprocess.CompletedProcess(program.args, program.returncode, output, errors)


def compilations(output: str) -> int:
    """Return how many times a program has compiled."""
    return output.count("INFO compiling 1 functions")


@contextmanager
def held_lock(cache: Path) -> Iterator[None]:
    """Hold the lock of the program that compiles."""
    with (cache / kernel_compiler._LOCK).open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def folder_in(cache: Path) -> Path:
    (folder,) = cache.glob("kernels-sample-*")
    return folder
