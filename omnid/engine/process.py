"""This process and those that it starts: signals that stop a run, Python programs.

Imports nothing that starts a thread. `python -m NAME` and `python -c TEXT` look for modules in the current folder
first, where a `numpy.py` may lie that another user wrote. Each program is therefore started with -P, which leaves that
folder out (Python 3.11 and later).
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # Ctrl-C, the service manager, a closed terminal


@contextmanager
def handle_stop_signals(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call handler(number, frame) for each stop signal within the context; signals ignored (nohup) stay ignored."""
    handled = [number for number in STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in handled}
    try:
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
