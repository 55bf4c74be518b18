"""The folder of compiled functions: read only where it is whole, and written by this program alone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from omnid.engine import kernel_store
from tests.omnid.engine.kernel_programs import (
    COMPILED_HERE,
    READ,
    compilations,
    folder_in,
    run,
)


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


def test_a_file_is_compiled_again_where_one_that_it_imports_changed() -> None:
    files = kernel_store.kernel_files()
    found = kernel_store.imported_files(files["omnid.core.odometry.slope_kernels"])
    assert sorted(path.stem for path in found.values()) == ["linear_kernels", "patch_kernels", "plane_kernels"]
    assert kernel_store.imported_files(files["omnid.core.odometry.patch_kernels"]) == {}
