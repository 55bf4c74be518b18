"""Time from the start of a program to its first result: `python -m tests.bench.start`.

`omnid demo`: to the first line with pairs, on a terminal. `omnid run` on the sample log: to the first pose that a
client receives. The others: the whole command, with its processor time and its memory, which a busy machine changes
less. `omnid replay` reads 5 pairs of the sample.
"""

from __future__ import annotations

import os
import pty
import resource
import signal
import subprocess
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path
from statistics import median

from omnid.client import Unreachable, subscribe
from tests.bench.results import ResultTable, columns, run
from tests.omnid.transport.bus_fixtures import free_endpoint

SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))
REPLAY = ("replay", str(SAMPLE), "--seconds", "0.45", "--quiet")
COMMANDS = {
    "`omnid --version`": ("--version",),
    "`omnid replay --help`": ("replay", "--help"),
    "`omnid --help`": ("--help",),
    "`omnid replay`, 5 pairs": REPLAY,
}


def demo_s(folder: Path) -> float:
    """Return the time to the first line of the demo that counts pairs."""
    start_s = time.monotonic()
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-m", "omnid", "demo", "--output", str(folder)])
    shown = b""
    while b"pairs/s" not in shown:
        shown += os.read(terminal, 4096)
    taken_s = time.monotonic() - start_s
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    os.close(terminal)
    return taken_s


def first_pose_s() -> float:
    """Return the time to the first pose of a daemon."""
    endpoint, start_s = free_endpoint(), time.monotonic()
    command = [sys.executable, "-m", "omnid", "run", "--log", str(SAMPLE), "--set", f'bus.listen=["{endpoint}"]']
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as daemon:
        while True:
            try:
                with subscribe(connect=(endpoint,)) as poses:
                    next(iter(poses))
                break
            except Unreachable:
                time.sleep(0.01)
        taken_s = time.monotonic() - start_s
        daemon.terminate()
    return taken_s


def command(words: tuple[str, ...]) -> tuple[float, float, float]:
    """Return time [s], processor time [s] and largest memory [MB] of a command; Linux counts that of this program
    before the other one begins, too.
    """
    start_s = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", "omnid", *words], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, words
    return time.monotonic() - start_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def start(*, runs: int = 5) -> None:
    """Print the medians of some runs."""
    with tempfile.TemporaryDirectory() as folder:
        rows = {"`omnid demo`: first line": [demo_s(Path(folder) / str(number)) for number in range(runs)]}
    rows["`omnid run`: first pose"] = [first_pose_s() for _ in range(runs)]
    times = (f"{name}|s|2" for name in (f"median of {runs}", "smallest", "largest", "processor time"))
    table = ResultTable("start", "Start of a program", columns("what", *times, "memory|MB|0"))
    for name, waited_s in rows.items():
        table.add(name, median(waited_s), min(waited_s), max(waited_s), None, None)
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    for name, words in COMMANDS.items():
        command(words)  # the first run compiles what is missing
        times_s, used_s, memory_mb = zip(*(command(words) for _ in range(runs)), strict=True)
        memory = median(memory_mb) if min(memory_mb) > 1.1 * own_mb else None
        table.add(name, median(times_s), min(times_s), max(times_s), median(used_s), memory)


if __name__ == "__main__":
    run(start)
