"""Compiled functions: made ready in programs of their own, kept on disk, and made again where the files are damaged."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from omnid.engine import kernel_compiler, kernel_store

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


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A cache that one program has filled, and what that program printed."""
    cache = tmp_path_factory.mktemp("cache")
    for index in range(kernel_store.MAX_FOLDERS + 9):
        old = cache / f"kernels-{index}"
        old.mkdir()
        os.utime(old, (index, index))
    return cache, run(cache).stdout


@pytest.fixture
def cache(compiled_once: tuple[Path, str], tmp_path: Path) -> Path:
    """A filled cache of the test's own."""
    return Path(shutil.copytree(compiled_once[0], tmp_path / "cache"))


def folder_in(cache: Path) -> Path:
    (folder,) = cache.glob("kernels-sample-*")
    return folder


def test_functions_are_compiled_by_a_helper_and_kept(compiled_once: tuple[Path, str]) -> None:
    cache, printed = compiled_once
    lines = printed.splitlines()
    assert lines[0].startswith("INFO compiling 1 functions") and lines[-2].startswith("INFO compiled in ")
    assert lines[-1] == READ
    kept = {path.name for path in cache.glob("kernels-*")}
    assert len(kept) == kernel_store.MAX_FOLDERS + 1 and "kernels-100" in kept and "kernels-0" not in kept
    assert not [*cache.glob("making-*")]


def test_a_copy_of_the_same_sources_compiles_nothing(cache: Path, tmp_path: Path) -> None:
    """As another virtual environment does, and an installation of a later day."""
    copy = tmp_path / "copy"
    for folder in ("omnid", "drivers", "calib", "tests/omnid/engine"):
        shutil.copytree(
            ROOT / folder,
            copy / folder,
            copy_function=shutil.copyfile,
            ignore=shutil.ignore_patterns("__pycache__", "*.mcap"),
        )
    (copy / "tests/__init__.py").touch()
    done = run(cache, root=copy)
    assert done.stdout == f"{READ}\n", done.stderr
    source = copy / "tests/omnid/engine/sample_kernels.py"
    source.write_text(source.read_text().replace("/ 2", "* 0.5"))
    changed = run(cache, root=copy)
    assert compilations(changed.stdout) == 1, changed.stderr


def test_damaged_files_are_never_read(cache: Path) -> None:
    code = next(folder_in(cache).glob("*.o"))
    damaged = bytearray(code.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    code.write_bytes(damaged)
    again = run(cache)
    assert compilations(again.stdout) == 1 and again.stdout.endswith(f"{READ}\n")
    assert kernel_store.is_intact(folder_in(cache))
    (folder_in(cache) / "digests.json").write_text("{")
    assert not kernel_store.is_intact(folder_in(cache))


def test_two_programs_compile_once(tmp_path: Path) -> None:
    with started(tmp_path) as one, started(tmp_path) as other:
        outputs = [program.communicate(timeout=300)[0] for program in (one, other)]
    assert compilations("".join(outputs)) == 1
    assert all(output.endswith(f"{READ}\n") for output in outputs)


def test_a_program_waits_for_the_one_that_compiles_and_goes_on_when_it_ends(tmp_path: Path) -> None:
    with ExitStack() as stack:
        with held_lock(tmp_path):
            program = stack.enter_context(started(tmp_path))
            assert program.stdout is not None and "another program compiles" in program.stdout.readline()
            assert program.poll() is None and not [*tmp_path.glob("kernels-*")]
        # The system has taken the lock from its holder, as it does where a program is killed.
        output, _ = program.communicate(timeout=300)
    assert compilations(output) == 1 and output.endswith(f"{READ}\n")


def test_a_program_that_hangs_is_not_waited_for(tmp_path: Path) -> None:
    """Nor are helpers that take too long: the program compiles itself."""
    with held_lock(tmp_path):
        done = run(tmp_path, "impatient")
    assert "WARNING it has compiled nothing for" in done.stdout, done.stderr
    assert done.stdout.endswith(f"{COMPILED_HERE}\n") and kernel_store.is_intact(folder_in(tmp_path))


def test_where_helpers_fail_the_program_compiles_itself(tmp_path: Path) -> None:
    done = run(tmp_path, "no-helpers")
    assert done.stdout.endswith(f"{COMPILED_HERE}\n"), done.stderr
    assert kernel_store.is_intact(folder_in(tmp_path))


def test_a_folder_that_cannot_be_used_gives_a_warning(cache: Path) -> None:
    (cache / "file").write_text("")
    assert kernel_store.why_unusable(cache / "file") == "File exists"
    before = sorted(cache.rglob("*"))
    cache.chmod(0o777)
    done = run(cache)
    assert "WARNING the compiled functions cannot be kept" in done.stdout and "others can write" in done.stdout
    assert "OMNID_CACHE_DIR" in done.stdout
    assert done.stdout.endswith(f"{COMPILED_HERE}\n"), f"what is there is not read: {done.stderr}"
    assert sorted(cache.rglob("*")) == before


def test_code_that_others_could_have_written_is_not_read(cache: Path) -> None:
    """The right digests do not help: a program that may write the code may write them, too."""
    folder = folder_in(cache)
    assert kernel_store.is_intact(folder) and not kernel_store.is_intact(folder, os.geteuid() + 1)
    for mode in (0o702, 0o720):
        folder.chmod(mode)
        assert not kernel_store.is_intact(folder)
    assert compilations(run(cache).stdout) == 1, "compiled again"
    assert kernel_store.is_intact(folder)
    for mode in (0o702, 0o720):
        cache.chmod(mode)
        assert "others can write" in kernel_store.why_unusable(cache)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_code_of_another_user_is_not_read(cache: Path) -> None:
    assert kernel_store.is_intact(folder_in(cache))
    os.chown(folder_in(cache), 12345, -1)
    assert not kernel_store.is_intact(folder_in(cache))
    os.chown(cache, 12345, -1)
    done = run(cache)
    assert "belongs to another user" in done.stdout and done.stdout.endswith(f"{COMPILED_HERE}\n")


def test_a_system_that_denies_compiled_code_is_named(tmp_path: Path) -> None:
    done = run(tmp_path, "deny")
    if done.returncode == 77:
        pytest.skip("this kernel has no PR_SET_MDWE (Linux 6.3)")
    assert "OmnidError: the system allows no code that is compiled at run time: remove MemoryDenyWrite" in done.stderr


def test_a_file_is_compiled_again_where_one_that_it_imports_changed() -> None:
    files = kernel_store.kernel_files()
    found = kernel_store.imported_files(files["omnid.core.odometry.slope_kernels"])
    assert sorted(path.stem for path in found.values()) == ["linear_kernels", "patch_kernels", "plane_kernels"]
    assert kernel_store.imported_files(files["omnid.core.odometry.patch_kernels"]) == {}
