"""Status of the threads: the share of a core that each of them takes."""

from __future__ import annotations

from typing import Final

from omnid.engine.thread_times import ThreadShares
from omnid.transport.codec import OK
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import THREADS, Key

MOST_THREADS: Final = 40  # names in a status, those of the largest shares: it is sent each second


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
