"""`omnid log`: show the content of logs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from omnid.commands.options import JSON, RATE, command, print_json
from omnid.utc import utc

if TYPE_CHECKING:
    from drivers.logs.open_log import LogInfo

MAX_COLUMN = 60  # Most characters of a topic or a type, so that a line of the table fits a terminal.
_MEND = "`mcap recover`, of mcap's own command line"
MAX_LINE = 5000  # Most characters of a line: it may contain the path of a file.


@command(RATE, JSON)
def info(args: argparse.Namespace) -> int:
    """Print topics, types, counts, times, attachments, and whether the log is whole.

    Exit code 1: one is broken; 2: one is no log.

    logs LOG...  .mcap, .mcap.part, .db3, .bag, or a folder of these or of images

    examples:
      log info recordings/*.mcap
      log info images --rate 20
    """
    from drivers.errors import DriverError
    from drivers.logs.open_log import LogState, log_info

    code, logs = 0, []
    for number, path in enumerate(args.logs):
        try:
            found = log_info(path, examine=True, rate_hz=args.rate or 0.0)
        except DriverError as error:
            print(f"omnid: {_shown(str(error))}", file=sys.stderr)
            code = 2
            continue
        logs.append(found)
        if not args.json:
            print(*[""] * bool(number), *_described(found), sep="\n")
        code = max(code, int(found.state is LogState.BROKEN))
    if args.json:
        print_json(logs)
    return code


def _described(found: LogInfo) -> Iterator[str]:
    """Yield a line for each property, and the table of topics."""
    from drivers.logs.open_log import LogState

    faults = [_shown(found.fault)] if found.fault else []
    if found.broken:
        faults.append(f"{found.broken} corrupt chunks or records, which are skipped")
    advice = f"; for other programs: {_MEND}" if found.path.suffix in (".mcap", ".part") else ""
    states = {
        LogState.BROKEN: f": {'; '.join(faults)}{advice}",
        LogState.UNINDEXED: f": omnid reads it{advice}",
    }
    yield f"log          {_shown(str(found.path))}"
    yield f"size         {_bytes(found.size_bytes)}"
    yield f"state        {found.state.value}{states.get(found.state, '')}"
    if found.span_ns is not None:
        first_ns, last_ns = found.span_ns
        yield f"time         {utc(first_ns)} to {utc(last_ns)}, {(last_ns - first_ns) / 1e9:.3f} s"
    yield f"messages     {found.messages}"
    listed = ", ".join(f"{_shown(name)} ({_bytes(size)})" for name, size in found.attachments.items())
    yield f"attachments  {listed or 'none'}"
    rows = [
        (_shown(name), _shown(kind) or "-", count, f"{found.rates_hz[name]:.2f}" if name in found.rates_hz else "-")
        for name, (kind, count) in found.topics.items()
    ]
    if rows:
        wide, wide_kind = (min(MAX_COLUMN, max(map(len, column))) for column in list(zip(*rows, strict=True))[:2])
        yield f"\n{'topic':<{wide}}  {'type':<{wide_kind}}{'messages':>10}{'Hz':>9}"
    for name, kind, count, rate in rows:
        yield f"{name:<{wide}}  {kind:<{wide_kind}}{count:>10}{rate:>9}"


def _shown(text: str) -> str:
    """Return a name or a line as it may be printed: the log may contain anything."""
    from omnid.plain_text import plain

    return plain(text, MAX_LINE)


def _bytes(size: int) -> str:
    for unit, factor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= factor:
            return f"{size / factor:.1f} {unit}"
    return f"{size} bytes"
