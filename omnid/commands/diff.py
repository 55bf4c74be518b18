"""`omnid diff`: differences between two recorded runs."""

from __future__ import annotations

import argparse
import logging
import math
from pathlib import Path

from omnid.commands.json_output import print_json
from omnid.commands.options import JSON, command, option
from omnid.errors import OmnidError

AGREE, DIFFER = 0, 1


@command(
    option(
        "a",
        type=Path,
        metavar="A.mcap",
        help="what `omnid run`, replay --record or listen --mcap wrote, or any log with nav_msgs/msg/Odometry",
    ),
    option("b", type=Path, metavar="B.mcap", help="likewise; poses of the same stamp are compared"),
    option(
        "--tolerance-mm",
        type=float,
        default=5.0,
        metavar="MM",
        help="closer poses count as the same, and commands that differ by less per second; default %(default)s",
    ),
    option("--tolerance-deg", type=float, default=0.1, metavar="DEG", help="likewise, of angles; default %(default)s"),
    option(
        "--shared",
        type=float,
        default=90.0,
        metavar="PERCENT",
        help="smallest share of the longer run's poses that the other must have; default %(default)s",
    ),
    option(
        "--align",
        action="store_true",
        help="align B with A at their first common pose: for runs that began at different images",
    ),
    option("--topic", metavar="TOPIC", help="the odometry topic of both, where there are several"),
    JSON,
    examples=("diff yesterday.mcap today.mcap",),
)
def run(args: argparse.Namespace) -> int:
    """Print the comparison; return 0 where the runs agree, 1 where they differ."""
    from omnid.engine.logging_setup import log_unlimited
    from omnid.plain_text import plain
    from omnid.recordings.comparison import RunComparison, Tolerance
    from omnid.recordings.run_series import read_run_series

    tolerance = Tolerance(
        1e-3 * _limit(args, "tolerance_mm"),
        math.radians(_limit(args, "tolerance_deg")),
        1e-2 * _limit(args, "shared"),
    )
    a, b = (read_run_series(path, args.topic) for path in (args.a, args.b))
    if _identical(a.path, b.path):
        if args.json:
            print_json({"agree": True, "identical": True, "differences": []})
        else:
            print(f"{plain(str(args.a))} and {plain(str(args.b))} are identical, byte for byte")
        return AGREE
    comparison = RunComparison(a, b, tolerance, align=args.align)
    for warning in (*a.warnings, *b.warnings):
        log_unlimited(logging.WARNING, warning)
    if args.json:
        differences = comparison.differences
        print_json({"agree": not differences, "identical": False, "differences": differences})
    else:
        print("\n".join(map(plain, comparison.lines())))
    return DIFFER if comparison.differences else AGREE


def _limit(args: argparse.Namespace, name: str) -> float:
    """Return the value of an option; raise OmnidError where it is negative or not finite."""
    value = float(getattr(args, name))
    if not 0.0 <= value < math.inf:
        raise OmnidError(f"--{name.replace('_', '-')} {value:g}: expected a number of 0 or more")
    return value


def _identical(a: Path, b: Path) -> bool:
    """True if both files hold the same bytes."""
    import filecmp

    try:
        return filecmp.cmp(a, b, shallow=False)
    except OSError as error:
        raise OmnidError(f"{error.filename}: cannot be read: {error.strerror}") from error
