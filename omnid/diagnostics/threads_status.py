"""Status of the threads: the share of a core that each takes, from Linux' /proc (proc(5), stat)."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from omnid.transport.codec import OK, DiagnosticStatus
from omnid.transport.status_names import THREADS, Key

LIBRARIES: Final = "libraries"  # threads that libraries started without a name: OpenCV's and BLAS's pools
MAIN: Final = "main"
MOST_THREADS: Final = 40  # names in a status, those of the largest shares: it is sent each second
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")
_USER, _SYSTEM = 11, 12  # fields of stat after the name: time in the program and in the kernel


class ThreadTime(NamedTuple):
    """Name of a thread, and the processor time that it has used [s]."""

    name: str
    used_s: float


class ThreadShare(NamedTuple):
    """Number of the threads of a name, and their share of a core."""

    threads: int
    share: float


def thread_times(pid: int = 0) -> dict[int, ThreadTime]:
    """Return the times of the threads of a process (0: this one), by their id; empty without /proc.

    The main thread is called MAIN, and threads that have its name LIBRARIES: a new thread has the name of the one that
    started it, until the program names it.
    """
    times: dict[int, ThreadTime] = {}
    main = pid or os.getpid()
    with suppress(OSError):
        for task in Path(f"/proc/{main}/task").iterdir():
            with suppress(FileNotFoundError):  # it has ended
                times[int(task.name)] = _parsed((task / "stat").read_text())
        inherited = times[main].name
        times = {
            tid: found._replace(name=LIBRARIES) if found.name == inherited else found for tid, found in times.items()
        }
        times[main] = times[main]._replace(name=MAIN)
    return times


def shares(before: dict[int, ThreadTime], after: dict[int, ThreadTime], seconds: float) -> dict[str, ThreadShare]:
    """Return the shares of a core between two readings by name, the largest first."""
    found: dict[str, ThreadShare] = {}
    for tid, now in after.items():
        # The system gives the id of a thread that has ended to another one later, whose time begins at 0 again.
        began_s = before[tid].used_s if tid in before and before[tid].used_s <= now.used_s else 0.0
        threads, share = found.get(now.name, ThreadShare(0, 0.0))
        found[now.name] = ThreadShare(threads + 1, share + (now.used_s - began_s) / seconds)
    return dict(sorted(found.items(), key=lambda entry: -entry[1].share))


class ThreadShares:
    """The shares of the threads of this process since they were asked for last."""

    def __init__(self) -> None:
        self._before, self._before_s = thread_times(), time.monotonic()

    def __call__(self) -> dict[str, ThreadShare]:
        """Return the shares by name, the largest first; empty without /proc, or where no time has passed."""
        after, now_s = thread_times(), time.monotonic()
        before, seconds = self._before, now_s - self._before_s
        self._before, self._before_s = after, now_s
        return shares(before, after, seconds) if seconds > 0 else {}


def _parsed(stat: str) -> ThreadTime:
    """Return name and time of a line of stat; the name is in brackets and may hold any character."""
    name, _, rest = stat.partition("(")[2].rpartition(")")
    fields = rest.split()
    return ThreadTime(name, (int(fields[_USER]) + int(fields[_SYSTEM])) / _TICKS_PER_S)


class ThreadsStatus:
    """Reports the shares since the last report."""

    def __init__(self) -> None:
        self._shares = ThreadShares()

    def __call__(self) -> DiagnosticStatus:
        """Return the shares of a core: of all threads under `all`, then by the threads' names, the largest first."""
        found = self._shares()
        values = {str(Key.ALL): f"{sum(entry.share for entry in found.values()):.3f}"}
        values |= {name: f"{entry.share:.3f}" for name, entry in list(found.items())[:MOST_THREADS]}
        return DiagnosticStatus(THREADS, OK, "share of a core by thread", values)
