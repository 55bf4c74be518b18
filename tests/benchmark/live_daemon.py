"""The live daemon that benchmarks measure: `omnid run` on a log, a simulated motor controller, an operator who drives.

OMNID_BENCHMARK_LOG: FOLDER:HZ, a folder with log.mcap and its rig.toml, and the rate of its pairs; without it, the
sample's at 10 Hz.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.resources import files
from pathlib import Path

from tests.ports import free_port
from tests.replay.live import Base, Daemon, Operator, answers, started
from tests.waiting import wait_until

FOLDER, _, HZ = os.environ.get("OMNID_BENCHMARK_LOG", f"{files('omnid.sample')}:10").rpartition(":")
RIG = ("--rig", f"{FOLDER}/rig.toml") if Path(FOLDER, "rig.toml").exists() else ()  # the sample's is attached


@contextmanager
def daemon(folder: Path, pace: float, *settings: str) -> Iterator[tuple[Daemon, Operator, Base]]:
    """Run `omnid run` on the log with a simulated motor controller and an operator who sends commands."""
    port = free_port()
    with ExitStack() as ends:
        base = Base(folder)
        ends.callback(base.close)
        words = [f'bus.listen=["tcp/127.0.0.1:{port}"]', *settings]
        command = [
            sys.executable,
            "-m",
            "omnid",
            "run",
            "--log",
            f"{FOLDER}/log.mcap",
            "--pace",
            str(pace),
            *RIG,
            "--motor",
            str(base.port),
            *(part for word in words for part in ("--set", word)),
        ]
        process = ends.enter_context(started(command, port))
        wait_until(lambda: answers(port) or not process.alive, "the daemon's answer")
        operator = Operator(port)
        ends.callback(operator.close)
        wait_until(lambda: operator.poses and operator.states, "a pose")
        operator.drive(0.2)
        yield process, operator, base
        code, err = process.end()
        assert code == 0, err
        assert "Traceback" not in err
