"""The line that shows how far a run is."""

from __future__ import annotations

import io
import os
import termios
from types import SimpleNamespace
from typing import Any, cast

from omnid.diagnostics.progress import Progress
from omnid.diagnostics.run_summary import RunStatistics


def line(seq: int, poses: int) -> str:
    statistics, stream = RunStatistics(), io.StringIO()
    statistics.newest, statistics.poses = cast("Any", SimpleNamespace(seq=seq, state="tracking")), poses
    Progress(statistics, 99, stream)()
    return stream.getvalue()


def test_counts_the_pairs_that_were_dropped_too() -> None:
    assert line(98, 58).startswith("omnid: 99/99 ") and line(98, 58).endswith("tracking  41 dropped\n")
    assert line(49, 50).startswith("omnid: 50/99 ") and "dropped" not in line(49, 50)


def test_fits_a_narrow_terminal() -> None:
    screen, terminal = os.openpty()
    termios.tcsetwinsize(terminal, (24, 30))
    statistics = RunStatistics()
    statistics.newest, statistics.poses = cast("Any", SimpleNamespace(seq=49, state="tracking")), 50
    with os.fdopen(terminal, "w") as stream:
        Progress(statistics, 99, stream)()
        drawn = os.read(screen, 1000).decode()
    os.close(screen)
    assert "[##" in drawn and max(map(len, drawn.split("\r"))) < 30
