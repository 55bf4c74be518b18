"""`omnid log`: show the content of logs, and recover an MCAP file that is cut or corrupt."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.json_output import add_json, print_json
from omnid.utc import utc

if TYPE_CHECKING:
    from drivers.logs.mcap_info import LogInfo
    from drivers.logs.mcap_recovery import Recovery

MAX_COLUMN = 60  # Most characters of a topic or a type, so that a line of the table fits a terminal.
MAX_LINE = 5000  # Most characters of a line: it may contain the path of a file.


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `log` to the command line."""
    parser = subparsers.add_parser("log", help="show the content of logs, and recover broken ones")
    actions = parser.add_subparsers(required=True, metavar="action", parser_class=type(parser))
    info = actions.add_parser("info", help="topics, types, counts, times, attachments, and whether the log is whole")
    info.add_argument(
        "logs",
        type=Path,
        nargs="+",
        metavar="LOG",
        help=".mcap, .mcap.part, .db3, .bag, or a folder of these or of images",
    )
    add_json(info)
    info.set_defaults(run=run_info)
    recover = actions.add_parser("recover", help="write all readable messages of a cut or corrupt log to a new one")
    recover.add_argument("log", type=Path, metavar="FILE", help=".mcap or .mcap.part, of any program")
    recover.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT",
        help="default: FILE without .part, or FILE.recovered.mcap; nothing is overwritten",
    )
    recover.set_defaults(run=run_recover)


def run_info(args: argparse.Namespace) -> int:
    """Print the content of each log; return 1 if one is broken, 2 if one is no log."""
    from drivers.errors import DriverError
    from drivers.logs.log_formats import log_info
    from drivers.logs.mcap_info import LogState

    code, logs = 0, []
    for number, path in enumerate(args.logs):
        try:
            found = log_info(path)
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


def run_recover(args: argparse.Namespace) -> int:
    """Recover a log. A whole log is copied only if --output is given."""
    from drivers.logs.mcap_recovery import recover

    out = args.output or _default_output(args.log)
    found = recover(args.log, out)
    if found.whole and args.output is None:
        out.unlink()
        print(_shown(f"{args.log} is whole: there is nothing to recover; -o FILE makes a copy"))
        return 0
    print("\n".join(map(_shown, _reported(found, args.log, out))))
    return 0


def _default_output(path: Path) -> Path:
    from drivers.logs.log_folder import PART_SUFFIX, complete_path

    return complete_path(path) if path.name.endswith(PART_SUFFIX) else path.with_name(f"{path.stem}.recovered.mcap")


def _reported(found: Recovery, path: Path, out: Path) -> Iterator[str]:
    yield f"{out}: {found.messages} messages and {found.attachments} attachments saved"
    if found.whole:
        yield f"{path} was already whole"
        return
    if found.lost:
        yield f"lost: {found.lost} messages"
    elif found.lost is None:
        yield "lost: unknown, the log has no count of its messages"
    if found.broken:
        yield f"skipped: {found.broken} corrupt chunks or records"
    yield f"{path} is readable up to byte {found.end} of {path.stat().st_size}; it was not changed"


def _described(found: LogInfo) -> Iterator[str]:
    yield f"log          {_shown(str(found.path))}"
    yield f"size         {_bytes(found.size_bytes)}"
    yield f"state        {_state(found)}"
    duration_s = 0.0
    if found.span_ns is not None:
        first_ns, last_ns = found.span_ns
        duration_s = max(0.0, (last_ns - first_ns) / 1e9)
        yield f"time         {utc(first_ns)} to {utc(last_ns)}, {duration_s:.3f} s"
    yield f"messages     {found.messages}"
    listed = ", ".join(f"{_shown(name)} ({_bytes(size)})" for name, size in found.attachments.items())
    yield f"attachments  {listed or 'none'}"
    if found.topics:
        yield from _table(found, duration_s)


def _state(found: LogInfo) -> str:
    from drivers.logs.mcap_info import LogState

    advice = f"`omnid log recover {_shown(str(found.path))}`"
    if found.state is LogState.BROKEN and found.path.suffix not in (".mcap", ".part"):
        return f"cut or corrupt, with {found.broken} corrupt records: what can be read is used"
    if found.state is LogState.BROKEN:
        corrupt = f", with {found.broken} corrupt chunks or records," if found.broken else ""
        position = f"byte {found.readable_bytes} of {found.size_bytes}"
        return f"cut or corrupt after {position}{corrupt}: {advice} saves the readable messages"
    if found.state is LogState.UNINDEXED:
        return f"{found.state.value}, so some readers refuse it: {advice} adds one"
    return str(found.state.value)


def _table(found: LogInfo, duration_s: float) -> Iterator[str]:
    rows = [(_shown(name), _shown(kind) or "-", count) for name, (kind, count) in found.topics.items()]
    wide = min(MAX_COLUMN, max(len(name) for name, _, _ in rows))
    wide_kind = min(MAX_COLUMN, max(len(kind) for _, kind, _ in rows))
    yield ""
    yield f"{'topic':<{wide}}  {'type':<{wide_kind}}{'messages':>10}{'Hz':>9}"
    for name, kind, count in rows:
        rate = f"{(count - 1) / duration_s:.2f}" if count > 1 and duration_s > 0 else "-"
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
