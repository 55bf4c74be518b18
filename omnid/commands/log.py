"""`omnid log`: show the content of logs."""

from __future__ import annotations

import argparse
import sys

from drivers.errors import DriverError
from drivers.logs.open_log import LogInfo, LogState, log_info
from omnid.commands.options import JSON, RATE, command, print_entries, print_json
from omnid.plain_text import plain
from omnid.utc import utc

MAX_COLUMN = 60  # Most characters of a topic or a type, so that a line of the table fits a terminal.
_MEND = "; for other programs: `mcap recover`, of mcap's own command line"
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
    code, logs = 0, []
    for number, path in enumerate(args.logs):
        try:
            found = log_info(path, examine=True, rate_hz=args.rate or 0.0)
        except DriverError as error:
            print(f"omnid: {plain(str(error), MAX_LINE)}", file=sys.stderr)
            code = 2
            continue
        logs.append(found)
        if not args.json:
            print("\n" * bool(number), end="")
            _show(found)
        code = max(code, int(found.state is LogState.BROKEN))
    if args.json:
        print_json(logs)
    return code


def _show(found: LogInfo) -> None:
    """Print the properties of a log, and the table of its topics. The log may contain anything."""
    faults = [found.fault] if found.fault else []
    faults += [f"{found.broken} corrupt chunks or records, which are skipped"] if found.broken else []
    states = {LogState.BROKEN: f": {'; '.join(faults)}", LogState.UNINDEXED: ": omnid reads it"}
    state = found.state.value + states.get(found.state, "")
    if found.state in states and found.path.suffix in (".mcap", ".part"):
        state += _MEND
    time = ""
    if found.span_ns is not None:
        first_ns, last_ns = found.span_ns
        time = f"{utc(first_ns)} to {utc(last_ns)}, {(last_ns - first_ns) / 1e9:.3f} s"
    listed = ", ".join(f"{name} ({_bytes(size)})" for name, size in found.attachments.items())
    entries = {"log": str(found.path), "size": _bytes(found.size_bytes), "state": state, "time": time}
    entries |= {"messages": str(found.messages), "attachments": listed or "none"}
    print_entries({name: plain(text, MAX_LINE) for name, text in entries.items()})
    rows = [
        (
            plain(name, MAX_LINE),
            plain(kind) or "-",
            count,
            f"{found.rates_hz[name]:.2f}" if name in found.rates_hz else "-",
        )
        for name, (kind, count) in found.topics.items()
    ]
    if rows:
        wide, wide_kind = (min(MAX_COLUMN, max(map(len, column))) for column in list(zip(*rows, strict=True))[:2])
        print(f"\n{'topic':<{wide}}  {'type':<{wide_kind}}{'messages':>10}{'Hz':>9}")
    for name, kind, count, rate in rows:
        print(f"{name:<{wide}}  {kind:<{wide_kind}}{count:>10}{rate:>9}")


def _bytes(size: int) -> str:
    for unit, factor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= factor:
            return f"{size / factor:.1f} {unit}"
    return f"{size} bytes"
