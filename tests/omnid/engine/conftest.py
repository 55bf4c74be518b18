"""Fixtures of the engine: no thread outlives a test; a folder of compiled functions."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from omnid.engine import kernel_store
from tests.omnid.engine.kernel_programs import run


@pytest.fixture
def no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before  # threads of other tests may have ended meanwhile


@pytest.fixture(scope="package")
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
