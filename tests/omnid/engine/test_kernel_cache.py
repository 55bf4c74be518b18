"""Compiled functions: made ready by programs of their own, and kept for other programs of the same sources."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from omnid.engine import kernel_store
from tests.omnid.engine.kernel_programs import (
    READ,
    ROOT,
    compilations,
    run,
)


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


def test_a_system_that_denies_compiled_code_is_named(tmp_path: Path) -> None:
    done = run(tmp_path, "deny")
    if done.returncode == 77:
        pytest.skip("this kernel has no PR_SET_MDWE (Linux 6.3)")
    assert "OmnidError: the system allows no code that is compiled at run time: remove MemoryDenyWrite" in done.stderr
