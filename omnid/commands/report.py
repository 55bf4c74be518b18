"""`omnid report`: one HTML page about a recording."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from omnid.commands.options import TRUTH, command, option


@command(
    option(
        "log",
        type=Path,
        metavar="LOG",
        help="what `omnid replay --record` or `omnid run` with record.enabled wrote, or any MCAP with "
        "nav_msgs/msg/Odometry",
    ),
    option("-o", "--output", type=Path, metavar="FILE", default=Path("report.html"), help="default: report.html"),
    TRUTH,
    option("--topic", metavar="TOPIC", help="the odometry topic, where there are several"),
    examples=("report out.mcap -o report.html",),
)
def run(args: argparse.Namespace) -> int:
    """Write the page."""
    from calib.atomic_file import write_file
    from omnid.formats.tum import read_tum
    from omnid.plain_text import plain
    from omnid.report.recorded_run import read_run
    from omnid.report.report import report_html
    from omnid.sinks.files import check_outputs, on_stdout

    inputs = [("the log that is read", args.log)] + ([("the truth", args.truth)] if args.truth else [])
    check_outputs([("--output", args.output)], inputs)
    truth = read_tum(args.truth) if args.truth else None
    recorded = read_run(args.log, args.topic)
    html = report_html(recorded, truth)
    write_file(args.output, html.encode("utf-8", "replace"))  # a file's name may be no text
    output = sys.stderr if on_stdout([("--output", args.output)]) else sys.stdout
    line = f"{args.output}: {len(recorded.t_s)} poses of {recorded.topic}, {len(html) / 1e6:.2f} MB"
    print(plain(line), file=output)
    return 0
