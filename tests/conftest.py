"""A small rendered run for everybody: 24 pairs between two walls at 256 px, a second to make."""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from omnid.core.compiled import cache_folder, why_unusable
from omnid.engine.kernel_cache import prepare_kernels
from tests.replay.command import Command
from tests.replay.edited import images, save
from tests.simulation import build, write_log

# Each of the some hundred programs that tests start would compile all its modules again: 0.5 s each.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

PAIRS = 24
COURSE_PAIRS = 22  # before the turn
LONG = ("replay", "bench", "omnid/simulation", "omnid/web", "omnid/commands", "omnid/calibration", "documents")


def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers of `-n auto`: one more than cores, as live tests wait, unless the cores are busy."""
    cores = len(os.sched_getaffinity(0))
    return cores + (os.getloadavg()[0] < cores)


def pytest_configure(config: pytest.Config) -> None:
    """Hand the files to the workers of `--dist loadfile` in the order of `pytest_collection_modifyitems`."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False  # else those with the fewest tests come last, which take longest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the folders whose files take long, so that no worker has such a one left when the others have ended.

    Their tests run programs, drives and calibrations.
    """
    first = [Path(__file__).parent / folder for folder in LONG]
    items.sort(key=lambda item: not any(item.path.is_relative_to(folder) for folder in first))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collect no garbage while tests are collected, nor ever search what was made by then: it stays to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def kernels(request: pytest.FixtureRequest) -> None:
    """Compile the functions of omnid once, or read them from the cache folder, before the first test.

    The tests beside this file read source code only. Programs that tests start use the same folder, also where a test
    gives them another home. Of several workers one compiles, the others wait.
    """
    os.environ["OMNID_CACHE_DIR"] = str(cache_folder())
    if any(item.path.parent != Path(__file__).parent for item in request.session.items):
        if why_unusable(cache_folder()):
            prepare_kernels()
            return
        with (cache_folder() / "tests.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            prepare_kernels()


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with log.mcap, rig.toml and truth.txt."""
    folder = tmp_path_factory.mktemp("scene")
    run = build("two_walls", seed=3, size=256, pairs=PAIRS)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    return folder


@pytest.fixture(scope="session")
def course(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene without its turn of 94 degrees within 0.1 s, for live runs: a base could follow it to and fro.

    At such a turn the controller voids the command, so the wheels slow down until the next one.
    """
    folder = tmp_path_factory.mktemp("course")
    taken = images(scene / "log.mcap")
    save(folder / "log.mcap", (image for image in taken if image.pair < COURSE_PAIRS))
    shutil.copy(scene / "rig.toml", folder / "rig.toml")
    rows = (scene / "truth.txt").read_text().splitlines(keepends=True)
    (folder / "truth.txt").write_text("".join(rows[:COURSE_PAIRS]))
    return folder


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another world, seen by the cameras of `scene`."""
    folder = tmp_path_factory.mktemp("elsewhere")
    run, other = build("two_walls", seed=3, size=256, pairs=PAIRS), build("two_walls", seed=8, size=256, pairs=PAIRS)
    write_log(folder, run.rig, run.poses, other.scene, sensor=run.sensor, seed=8)
    return folder


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Handle SIGINT and SIGHUP as in a terminal, also in child processes, although a parent ignores them (nohup)."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str]) -> Command:
    """Return the command line as a function."""
    return Command(capsys)
