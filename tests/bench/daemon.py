"""The whole daemon under load: `python -m tests.bench.daemon [--rates 10 30] [--busy 0 1]`.

`omnid run` plays a log that begins again at its end, with all stages, the bus, an operator who sends commands, and a
simulated motor controller. Measured are its processor time, its memory, and the time from the stamp of a pair until a
client has its pose, beside computing processes for each core. The log is the sample; the variable OMNID_BENCHMARK_LOG
names another: FOLDER:HZ, a folder with log.mcap and its rig.toml, and the rate of its pairs.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Final

import numpy as np

from tests.bench.results import Cell, ResultTable, columns, run
from tests.busy import busy_processes
from tests.ports import free_port
from tests.replay.live import Base, Daemon, Operator, answers, started
from tests.waiting import wait_until

FOLDER, _, HZ = os.environ.get("OMNID_BENCHMARK_LOG", f"{files('omnid.sample')}:10").rpartition(":")
RIG = ("--rig", f"{FOLDER}/rig.toml") if Path(FOLDER, "rig.toml").exists() else ()  # the sample's is attached
COLUMNS: Final = columns(
    *("images, busy processes per core", "share of a core||2", "resident|MB|0", "most|MB|0", "poses/s||1"),
    *(f"stamp to client, p{percent}|ms|1" for percent in (50, 90, 99)),
    *("late ticks of the wheels, p99|ms|1", "threads"),
)


@contextmanager
def daemon(folder: Path, pace: float, *settings: str) -> Iterator[tuple[Daemon, Operator, Base]]:
    """Run `omnid run` on the log with a simulated motor controller and an operator who sends commands."""
    port = free_port()
    with ExitStack() as ends:
        base = Base(folder)
        ends.callback(base.close)
        command = [sys.executable, "-m", "omnid", "run", "--log", f"{FOLDER}/log.mcap", "--pace", str(pace), *RIG]
        command += ["--motor", str(base.port), "--set", f'bus.listen=["tcp/127.0.0.1:{port}"]']
        command += [part for word in settings for part in ("--set", word)]
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


def status(pid: int) -> dict[str, int]:
    """Return the numbers of /proc/PID/status."""
    lines = (line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {name: int(value.split()[0]) for name, value in lines if value.split()[:1] and value.split()[0].isdigit()}


def process_time_s(pid: int) -> float:
    """Return the processor time of a process [s], with that of its threads that have ended."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def received_ms(operator: Operator, seconds: float) -> list[float]:
    """Return the latencies of the poses that an operator receives in so long a time."""
    found: list[float] = []
    until, seen = time.monotonic() + seconds, len(operator.poses)
    while time.monotonic() < until:
        time.sleep(0.001)
        now_ns, new = time.time_ns(), operator.poses[seen:]
        found += [1e-6 * (now_ns - pose.stamp_ns) for pose in new]
        seen += len(new)
    return found


def measure(rate_hz: float, per_core: int, seconds: float, warm_s: float, settings: Sequence[str]) -> list[Cell]:
    """Run the daemon at a rate of pairs beside computing processes, and return its row."""
    with (
        busy_processes(per_core * (os.cpu_count() or 1)),
        tempfile.TemporaryDirectory() as folder,
        daemon(Path(folder), rate_hz / float(HZ), *settings) as (process, operator, _),
    ):
        pid = process.process.pid
        time.sleep(warm_s)
        before_s, start_s = process_time_s(pid), time.monotonic()
        latencies_ms = np.array(received_ms(operator, seconds))
        share = (process_time_s(pid) - before_s) / (time.monotonic() - start_s)
        found = status(pid)
        late_ms = operator.values("wheels").get("tick_late_p99_ms", "nan")
    return [
        f"{rate_hz:g} Hz, {per_core} busy",
        share,
        found["VmRSS"] / 1024,
        found["VmHWM"] / 1024,
        len(latencies_ms) / seconds,
        *np.percentile(latencies_ms, (50, 90, 99)).tolist(),
        float(late_ms),
        found["Threads"],
    ]


def whole_daemon(
    *,
    rates: Sequence[float] = (10.0, 30.0),
    busy: Sequence[int] = (0, 1),
    seconds: float = 60.0,
    warm_s: float = 15.0,
    set_: Sequence[str] = (),
) -> None:
    """Print a row for each rate [Hz] and number of busy processes a core; warm_s: until caches and maps are full."""
    table = ResultTable("daemon", "The whole daemon", COLUMNS, timed=True)
    for rate_hz in rates:
        for per_core in busy:
            table.add(*measure(rate_hz, per_core, seconds, warm_s, set_))


if __name__ == "__main__":
    run(whole_daemon)
