"""Times of the threads of a replay, a pair: `python -m tests.benchmark.replay_threads FOLDER [--hz 30] [--small]`.

The folder holds log.mcap and a rig.toml or camchain.yaml; its pairs are read to and fro. A thread computes, waits for a
processor that others use, waits for messages or until the next stage takes its own, or waits for a result that another
thread computes (the dense depth of a pair). What is left is waiting for Python's lock and for the disk; it is a little
below zero where a wait for a processor falls into another wait. No replay is faster than its processor time on two
cores, nor than the thread that waits for no messages.
"""

from __future__ import annotations

import argparse
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple
from unittest.mock import patch

from omnid.commands.options import PROFILES
from omnid.config import load_config
from omnid.engine.graph import Graph
from omnid.engine.inbox import StageInbox
from omnid.engine.kernel_cache import prepare_kernels
from omnid.engine.one_at_a_time import OneAtATime
from omnid.engine.realtime import name_thread
from omnid.messages import OdometryUpdate
from tests.benchmark.budget import run_replay
from tests.benchmark.results import Column, ResultTable

# Pairs left out: the first ones, in which caches, buffers and the first map are filled, and the last ones, as threads
# end while others still compute.
SKIPPED: Final = 20
CORES: Final = 2  # for which the bound is stated
LEAST_MS: Final = 0.05  # threads that compute less a pair are left out
WAITS: Final = ((StageInbox, "get"), (StageInbox, "put"), (OneAtATime, "__enter__"))
NAMES: Final = ("computes", "waits for a processor", "for messages", "for the next stage", "for a result", "the rest")
Waited = Counter[tuple[str, str]]  # [s] by names of thread and method


class Reading(NamedTuple):
    """Times [s] of the threads up to a pose, by their names."""

    at_s: float
    ran_s: dict[str, float]
    queued_s: dict[str, float]  # ready to run, while no processor was free
    waited_s: Waited


class Readings:
    """A sink that reads the times after the first pairs and before the last ones."""

    def __init__(self, waited: Waited, pairs: int) -> None:
        self._waited, self._seqs = waited, (SKIPPED, pairs - SKIPPED)
        self.readings: list[Reading] = []

    def process(self, odometry: OdometryUpdate) -> None:
        """Read the times, if the pair is one of both (proc(5), schedstat)."""
        if odometry.seq not in self._seqs:
            return
        ran_s, queued_s = {}, {}
        for task in Path("/proc/self/task").iterdir():
            ran_ns, queued_ns, _ = (task / "schedstat").read_text().split()
            name = (task / "comm").read_text().strip()
            ran_s[name], queued_s[name] = int(ran_ns) * 1e-9, int(queued_ns) * 1e-9
        self.readings.append(Reading(time.perf_counter(), ran_s, queued_s, self._waited.copy()))


@contextmanager
def measured_waits() -> Iterator[Waited]:
    """Measure how long the threads wait in the methods of WAITS."""
    waited: Waited = Counter()

    def measured(method: Callable[..., Any], name: str) -> Callable[..., Any]:
        @wraps(method)
        def call(*args: object) -> Any:
            begun_s = time.perf_counter()
            result = method(*args)
            waited[threading.current_thread().name, name] += time.perf_counter() - begun_s
            return result

        return call

    with ExitStack() as patches:
        for kind, name in WAITS:
            patches.enter_context(patch.object(kind, name, measured(getattr(kind, name), name)))
        yield waited


def measure(folder: Path, pairs: int, hz: float, overrides: tuple[str, ...]) -> tuple[Reading, Reading]:
    """Run the stages in threads over so many pairs, hz a second, and return the times of the threads."""
    config = load_config(None, overrides)
    prepare_kernels()
    with TemporaryDirectory() as work, measured_waits() as waited:
        readings = Readings(waited, pairs)
        graph = Graph(depth=config.graph.depth, on_thread=name_thread)
        run_replay(graph, folder, pairs, hz, config, Path(work), readings)
    first, last = readings.readings
    return first, last


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--pairs", type=int, default=300, help="pairs of the run (default: %(default)s)")
    parser.add_argument("--hz", type=float, default=30.0, help="pairs a second by the stamps (default: %(default)s)")
    parser.add_argument("--small", action="store_true", help="with the small profile")
    options = parser.parse_args()
    first, last = measure(options.folder, options.pairs, options.hz, PROFILES["small"] if options.small else ())
    columns = (Column("a pair"), *(Column(name, "ms", 2) for name in NAMES))
    table = ResultTable("replay_threads", "speed", "What the threads of a replay do", columns)
    each_ms = 1e3 / (options.pairs - 2 * SKIPPED)
    wall_ms = each_ms * (last.at_s - first.at_s)
    for name in sorted(last.ran_s, key=lambda name: -last.ran_s[name]):
        ran_ms, queued_ms = (
            each_ms * (after[name] - before.get(name, 0.0))
            for before, after in ((first.ran_s, last.ran_s), (first.queued_s, last.queued_s))
        )
        waits = [each_ms * (last.waited_s[name, way] - first.waited_s[name, way]) for _, way in WAITS]
        if ran_ms >= LEAST_MS:
            table.add(name, ran_ms, queued_ms, *waits, wall_ms - ran_ms - queued_ms - sum(waits))
    whole_ms = each_ms * (sum(last.ran_s.values()) - sum(first.ran_s.values()))
    table.add("all", whole_ms, *[None] * 5)
    table.add(f"bound of {CORES} cores", whole_ms / min(CORES, os.cpu_count() or 1), *[None] * 5)
    table.add("time by the clock", wall_ms, *[None] * 5)


if __name__ == "__main__":
    main()
