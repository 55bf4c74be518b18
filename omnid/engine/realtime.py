"""Real-time settings of the live daemon: scheduling priorities, locked memory, garbage collection, switch interval.

Only threads that mostly wait become SCHED_FIFO, never the process: a FIFO thread that does not wait blocks its core
for all others. Two safeguards: threads that it starts are ordinary ones (SCHED_RESET_ON_FORK), and by default the
kernel leaves 5 % of each second to other threads (sched_rt_runtime_us). A FIFO thread still waits for Python's global
lock, up to the switch interval, which is therefore short.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import resource
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from omnid.engine.logging_setup import log

CAP_IPC_LOCK: Final = 14
CAP_SYS_NICE: Final = 23
LOCK_ADVICE: Final = (
    "set LimitMEMLOCK=infinity in the unit, or 'memlock unlimited' in /etc/security/limits.d, or "
    "realtime.lock_memory = false"
)
SWITCH_INTERVAL_S: Final = 1e-3  # time after which Python switches threads
_PR_SET_NAME: Final = 15
# MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT; without the last one, untouched stacks take 400 MB.
_MCL_ALL: Final = 1 | 2 | 4
_LIBC: Final = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class RealtimeSettings:
    """Requests to the kernel and to Python, so that deadlines hold."""

    lock_memory: Annotated[bool, "lock all memory against swapping; needs LimitMEMLOCK=infinity"] = True
    motor_priority: Annotated[
        int, Meta(ge=0, le=99), "SCHED_FIFO priority of the controller's tick, needs LimitRTPRIO; 0: none"
    ] = 20
    capture_priority: Annotated[int, Meta(ge=0, le=99), "SCHED_FIFO priority of the capture threads; 0: none"] = 10


def prepare(config: RealtimeSettings) -> str:
    """Apply the settings of the process, after the wiring and before the run; return what is refused, else ""."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()  # what exists at the start is not examined again
    return lock_memory() if config.lock_memory else ""


class ThreadStart:
    """Sets name and priority of a thread; called in the thread itself, before its work.

    A refused priority is reported once for all threads, which then run as ordinary ones.
    """

    def __init__(self, priorities: Mapping[str, int], report: Callable[[int, str], object] = log) -> None:
        """priorities: of SCHED_FIFO by name of the thread, 1 to 99; 0 or no entry for an ordinary thread."""
        self._priorities, self._report = dict(priorities), report
        self.refused = False

    def __call__(self, name: str) -> None:
        """Set name and priority of the calling thread."""
        name_thread(name)
        priority = self._priorities.get(name, 0)
        if priority and not set_realtime_priority(priority) and not self.refused:
            self.refused = True
            self._report(
                logging.WARNING,
                f"thread '{name}' cannot have real-time priority {priority}, nor can others: "
                f"{priority_advice(max(self._priorities.values()))}",
            )


def set_realtime_priority(priority: int) -> bool:
    """Make the calling thread SCHED_FIFO; False if that is not allowed."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))  # 0: this thread
        return True
    return False


def name_thread(name: str) -> None:
    """Set the kernel's name of the calling thread, of which `top -H` shows the first 15 bytes."""
    _LIBC.prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def lock_memory() -> str:
    """Lock all memory, now and later, against swapping; return the reason if that is refused, else "".

    Under a limit nothing is locked: allocations beyond it would fail.
    """
    if not may_lock():
        return f"memory is not locked, it may be swapped out: {LOCK_ADVICE}"
    if _LIBC.mlockall(_MCL_ALL) != 0:
        return f"memory is not locked, it may be swapped out: {os.strerror(ctypes.get_errno())}; {LOCK_ADVICE}"
    return ""


def may_lock() -> bool:
    """True if this process may lock any amount of memory."""
    return resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY or has_capability(CAP_IPC_LOCK)


def highest_priority() -> int:
    """Return the highest real-time priority that this process may give its threads; 0: none."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    return 99 if has_capability(CAP_SYS_NICE) or limit == resource.RLIM_INFINITY else limit


def has_capability(number: int) -> bool:
    """True if this process has the effective capability; False without /proc."""
    with suppress(OSError, ValueError):
        status = Path("/proc/self/status").read_bytes()
        words = next(line.split() for line in status.splitlines() if line.startswith(b"CapEff:"))
        return bool(int(words[1], 16) >> number & 1)
    return False


def priority_advice(priority: int) -> str:
    """Return advice on how to allow a real-time priority."""
    return (
        f"set LimitRTPRIO={priority} in the unit, or 'rtprio {priority}' in /etc/security/limits.d, or "
        "realtime.motor_priority = 0 and realtime.capture_priority = 0"
    )
