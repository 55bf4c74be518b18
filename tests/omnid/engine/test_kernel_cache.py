"""Compiled functions kept on the disk: one program compiles them, later ones read them, and nothing else.

A copy of omnid has three files with compiled functions, of which one calls another, so that a test takes seconds.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
CALLEE = """
from omnid.core.compiled import inner

@inner
def part(value):
    return value / 2
"""
CALLER = """
from omnid.core.callee_kernels import part
from omnid.core.compiled import compiled

@compiled("(f8[::1], f8[::1])", writes=("out",))
def parts(values, out):
    for n in range(len(values)):
        out[n] = part(values[n])
"""
PROGRAM = """
import logging
from omnid.engine.kernel_cache import prepare_kernels
prepare_kernels(lambda level, line: print(logging.getLevelName(level), line, flush=True))
import numpy as np
from omnid.core.caller_kernels import parts
out = np.zeros(2)
parts(np.array([3.0, 6.0]), out)
print(out.tolist())
"""
OTHER = """
from omnid.core.compiled import compiled

@compiled("(f8[::1],)", writes=("out",))
def zero(out):
    out[:] = 0
"""
HALVES = "[1.5, 3.0]"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with the copy of omnid."""
    for package in ("omnid", "drivers", "calib"):
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "*.mcap", "*_kernels.py")
        )
    (tmp_path / "omnid/core/callee_kernels.py").write_text(CALLEE)
    (tmp_path / "omnid/core/caller_kernels.py").write_text(CALLER)
    (tmp_path / "omnid/core/other_kernels.py").write_text(OTHER)
    return tmp_path


def started(copy: Path, cache: Path) -> subprocess.Popen[str]:
    environment = os.environ | {"OMNID_CACHE_DIR": str(cache), "PYTHONPATH": str(copy)}
    command, pipe = [sys.executable, "-P", "-c", PROGRAM], subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment, cwd=copy)


def run(copy: Path, cache: Path) -> list[str]:
    """Return what a program prints."""
    with started(copy, cache) as program:
        output, errors = program.communicate(timeout=300)
    return (output + errors).splitlines()


def test_the_first_program_compiles_and_others_read_until_a_file_is_edited(copy: Path) -> None:
    """Also one that only the callee is in, which numba itself would not notice; the code of other files stays."""
    cache = copy / "cache"
    with started(copy, cache) as one, started(copy, cache) as other:
        outputs = [program.communicate(timeout=300)[0].splitlines() for program in (one, other)]
    assert [output[-1] for output in outputs] == [HALVES, HALVES]
    assert any(output[0].startswith("INFO compiling the loops") for output in outputs)
    assert run(copy, cache) == [HALVES]
    kept = {path.name for path in cache.iterdir()}
    assert {name.partition("-")[0] for name in kept} == {"callee_kernels", "caller_kernels", "other_kernels"}
    (copy / "omnid/core/callee_kernels.py").write_text(CALLEE.replace("/ 2", "/ 3"))
    first, *_, last = run(copy, cache)
    assert first.startswith("INFO compiling") and last == "[1.0, 2.0]"
    now = {path.name for path in cache.iterdir()}
    assert len(now) == 3 and {name.partition("-")[0] for name in now & kept} == {"other_kernels"}


def test_code_that_others_could_have_written_is_not_read(copy: Path) -> None:
    cache = copy / "cache"
    run(copy, cache)
    for kept in cache.glob("caller_kernels-*"):
        kept.chmod(0o720)
    assert run(copy, cache)[0].startswith("INFO compiling") and run(copy, cache) == [HALVES]
    for mode, owner in ((0o702, -1), (0o700, 12345)):
        cache.chmod(mode)
        if owner >= 0 and os.geteuid() != 0:
            continue
        os.chown(cache, owner, -1)
        warning, result = run(copy, cache)
        assert "it belongs to another user, or others can write to it" in warning and result == HALVES
