"""Compiled functions: made ready in programs of their own, kept on disk, and made again where the files are damaged."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from omnid.engine import kernel_cache

# One function of its own, so that a test takes a second: the files of core compile in conftest.py already.
PROGRAM = """
import logging, sys
from omnid.engine import kernel_cache
from omnid.core import compiled
import tests.omnid.engine.sample_kernels as sample
kernel_cache._kernel_files = lambda: {sample.__name__: __import__("pathlib").Path(sample.__file__)}
if sys.argv[1:] == ["deny"]:
    import ctypes
    if ctypes.CDLL(None, use_errno=True).prctl(65, 1, 0, 0, 0) != 0:  # PR_SET_MDWE, PR_MDWE_REFUSE_EXEC_GAIN
        sys.exit(77)
kernel_cache.prepare_kernels(lambda level, line: print(logging.getLevelName(level), line))
import numpy as np
out = np.zeros(2)
sample.halves(np.array([3.0, 5.0]), out)
print(out.tolist(), sum(kernel._compiled.stats.cache_hits.total() for kernel in compiled.declared()))
"""


def run(cache: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "OMNID_CACHE_DIR": str(cache)}
    return subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True, check=False,
                          env=environment, cwd=Path(__file__).parents[3])


def test_functions_are_compiled_once_and_damaged_files_are_never_read(tmp_path: Path) -> None:
    for index in range(kernel_cache.MAX_FOLDERS + 9):
        old = tmp_path / f"kernels-{index}"
        old.mkdir()
        os.utime(old, (index, index))
    first, second = run(tmp_path), run(tmp_path)
    lines = first.stdout.splitlines()
    assert lines[0].startswith("INFO compiling 1 functions") and lines[1].startswith("INFO compiled in ")
    assert lines[2:] == ["[1.5, 2.5] 0"]
    assert second.stdout.splitlines() == ["[1.5, 2.5] 1"], second.stderr
    kept = {path.name for path in tmp_path.iterdir()}
    assert len(kept) == kernel_cache.MAX_FOLDERS + 1 and "kernels-100" in kept and "kernels-0" not in kept

    (folder,) = tmp_path.glob("kernels-sample-*")
    code = next(folder.rglob("*.nbc"))
    damaged = bytearray(code.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    code.write_bytes(damaged)
    again = run(tmp_path)
    assert again.stdout.startswith("INFO compiling") and again.stdout.endswith("[1.5, 2.5] 0\n")
    assert kernel_cache._is_intact(folder)
    (folder / "digests.json").write_text("{")
    assert not kernel_cache._is_intact(folder)


def test_a_folder_that_cannot_be_used_gives_a_warning(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert kernel_cache._why_unusable(tmp_path / "file") == "File exists"
    tmp_path.chmod(0o777)
    done = run(tmp_path)
    assert "WARNING the compiled functions cannot be kept" in done.stdout and "others can write" in done.stdout
    assert "OMNID_CACHE_DIR" in done.stdout
    assert done.stdout.endswith("[1.5, 2.5] 0\n"), done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_code_that_others_could_have_written_is_not_read(tmp_path: Path) -> None:
    """The right digests do not help: a program that may write the code may write them, too."""
    run(tmp_path)
    assert run(tmp_path).stdout == "[1.5, 2.5] 1\n"
    (folder,) = tmp_path.glob("kernels-sample-*")
    assert kernel_cache._is_intact(folder) and not kernel_cache._is_intact(folder, os.geteuid() + 1)
    for mode in (0o720, 0o702):
        folder.chmod(mode)
        assert not kernel_cache._is_intact(folder)
        assert run(tmp_path).stdout.endswith("[1.5, 2.5] 0\n"), "compiled again"
    assert run(tmp_path).stdout == "[1.5, 2.5] 1\n"
    for mode in (0o720, 0o702):
        tmp_path.chmod(mode)
        done = run(tmp_path)
        assert "others can write" in done.stdout and done.stdout.endswith("[1.5, 2.5] 0\n"), "nothing is read from it"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_code_of_another_user_is_not_read(tmp_path: Path) -> None:
    run(tmp_path)
    (folder,) = tmp_path.glob("kernels-sample-*")
    os.chown(folder, 12345, -1)
    assert run(tmp_path).stdout.endswith("[1.5, 2.5] 0\n")
    assert run(tmp_path).stdout == "[1.5, 2.5] 1\n"
    os.chown(tmp_path, 12345, -1)
    done = run(tmp_path)
    assert "belongs to another user" in done.stdout and done.stdout.endswith("[1.5, 2.5] 0\n")


def test_a_system_that_denies_compiled_code_is_named(tmp_path: Path) -> None:
    done = run(tmp_path, "deny")
    if done.returncode == 77:
        pytest.skip("this kernel has no PR_SET_MDWE (Linux 6.3)")
    assert "OmnidError: the system allows no code that is compiled at run time: remove MemoryDenyWrite" in done.stderr


def test_a_file_is_compiled_again_where_one_that_it_imports_changed() -> None:
    files = kernel_cache._kernel_files()
    found = kernel_cache._with_imported(files["omnid.core.odometry.slope_kernels"])
    assert [path.stem for path in found] == ["slope_kernels", "linear_kernels", "patch_kernels", "plane_kernels"]
    assert kernel_cache._with_imported(files["omnid.core.odometry.patch_kernels"]) == [
        files["omnid.core.odometry.patch_kernels"]]
