"""Settings of this process and its threads, signals that stop a run, and Python programs that it starts.

Imports nothing that starts a thread. Only threads that mostly wait become SCHED_FIFO, never the process: a FIFO thread
that does not wait blocks its core for all others. Threads that it starts are ordinary ones (SCHED_RESET_ON_FORK). A
FIFO thread still waits for Python's global lock, up to the switch interval, which is therefore short.

`python -m NAME` looks for modules in the current folder first, where a `numpy.py` may lie that another user wrote. Each
program is therefore started with -P, which leaves that folder out.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Annotated, Any, Final

from msgspec import Meta

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, the service manager, a closed terminal
PRIORITY_ADVICE: Final = (
    "raise LimitRTPRIO in the unit, or set realtime.motor_priority and realtime.capture_priority to 0"
)
_LIBC: Final = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """Requests to the kernel, so that deadlines hold."""

    motor_priority: Annotated[
        int, Meta(ge=0, le=99), "SCHED_FIFO priority of the controller's tick, needs LimitRTPRIO; 0: none"
    ] = 20
    capture_priority: Annotated[int, Meta(ge=0, le=99), "SCHED_FIFO priority of the capture threads; 0: none"] = 10


def prepare() -> None:
    """Prepare the process for punctual threads, after the wiring and before the run.

    All memory is locked where that has no limit (LimitMEMLOCK=infinity): under one, later allocations would fail.
    """
    sys.setswitchinterval(1e-3)
    # Arrays of a pair take the memory of those before; else the kernel clears it anew, by a thousand page faults.
    _LIBC.mallopt(-3, 2**25)  # M_MMAP_THRESHOLD
    _LIBC.mallopt(-1, 2**28)  # M_TRIM_THRESHOLD
    gc.collect()
    gc.freeze()  # what exists at the start is not examined again
    if os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        _LIBC.mlockall(1 | 2 | 4)  # MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT: else untouched stacks would take 400 MB


def start_thread(name: str, priority: int = 0) -> str:
    """Set name and priority of the calling thread, before its work; return why it has no such priority, else "".

    priority: of SCHED_FIFO, 1 to 99; 0 for an ordinary thread, as which one runs whose priority is refused.
    """
    _LIBC.prctl(15, name.encode(), 0, 0, 0)  # PR_SET_NAME, of which `top -H` shows 15 bytes
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
        except OSError:
            return f"thread '{name}' cannot have real-time priority {priority}: {PRIORITY_ADVICE}"
    return ""


def highest_priority() -> int:
    """Return the highest real-time priority that this process may give its threads; 0: none."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    return 99 if os.geteuid() == 0 or limit == resource.RLIM_INFINITY else limit


@contextmanager
def handle_stop_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call handler(number, frame) for each stop signal within the context; signals ignored (nohup) stay ignored.

    Outside the main thread, where Python has no signal handlers, signals are left as they are.
    """
    handled = [number for number in STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before: dict[int, Any] = {}
    try:
        with suppress(ValueError):
            before = {number: signal.signal(number, handler) for number in handled}
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def python(*words: str) -> list[str]:
    """Return the command that runs this interpreter with words such as "-m", "omnid", "report"."""
    return [sys.executable, "-P", *words]


def python_environment(**changes: str) -> dict[str, str]:
    """Return this program's environment with changes; the program finds the modules that this one finds.

    The entries of PYTHONPATH are absolute, because the program may run in another folder.
    """
    found = os.pathsep.join(entry for entry in sys.path if os.path.isabs(entry))
    return os.environ | {"PYTHONPATH": found} | changes
