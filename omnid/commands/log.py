"""`omnid log info`: the content of logs; `omnid eval`: errors of a trajectory against the truth."""

from __future__ import annotations

import argparse
from collections import Counter
from contextlib import closing
from dataclasses import asdict

import numpy as np

from calib import se3
from drivers.errors import DriverError
from drivers.logs.log import Log
from drivers.logs.open_log import open_log
from omnid.commands.options import JSON, RATE, command, failed, print_entries, print_json
from omnid.formats.tum import Trajectory, read_tum
from omnid.plain_text import plain, utc
from omnid.recordings.evaluation import evaluate, turned_body

BROKEN = "cut or corrupt"


@command(RATE)
def info(args: argparse.Namespace) -> int:
    """Print topics, types, counts, times, attachments, and whether the log is whole.

    Exit code 1: one is broken; 2: one is no log.

    logs LOG...  .mcap, .db3, .bag, or a folder of these or of images

    examples:
      log info recordings/*.mcap
      log info images --rate 20
    """
    code = 0
    for number, path in enumerate(args.logs):
        try:
            log = open_log(path, args.rate or 0.0)
        except DriverError as error:
            failed(plain(str(error)))
            code = 2
            continue
        print("\n" * bool(number), end="")
        with closing(log):
            _show(log)
        code = max(code, int(log.state == BROKEN))
    return code


def _show(log: Log) -> None:
    """Print the properties of a log, and the table of its topics. The log may contain anything."""
    counts = Counter(message.topic for message in log.messages())  # what cannot be read shows by that
    faults = [log.cut] if log.cut else []
    faults += [f"{len(log.faults)} corrupt chunks or records, which are skipped"] if log.faults else []
    state = f"{log.state}: {'; '.join(faults)}" if log.state == BROKEN else log.state
    logged_ns, time = log.entries["time_ns"], ""
    if logged_ns.size:
        first_ns, last_ns = int(logged_ns.min()), int(logged_ns.max())
        time = f"{utc(first_ns)} to {utc(last_ns)}, {(last_ns - first_ns) / 1e9:.3f} s"
    listed = ", ".join(f"{name} ({_bytes(len(data))})" for name, data in log.attachments().items())
    entries = {"log": str(log.path), "size": _bytes(log.size_bytes), "state": state, "time": time}
    entries |= {"messages": str(counts.total()), "attachments": listed or "none"}
    print_entries({name: plain(text) for name, text in entries.items()})
    rows = []
    for number, (name, kind) in enumerate(log.topics.items()):
        span_s = 1e-9 * np.ptp(logged_ns[log.topic == number]) if counts[name] > 1 else 0.0
        rate = f"{(counts[name] - 1) / span_s:.2f}" if span_s else "-"
        rows.append((plain(name), plain(kind) or "-", counts[name], rate))
    rows.sort()
    if rows:
        wide, wide_kind = (max(map(len, column)) for column in list(zip(*rows, strict=True))[:2])
        print(f"\n{'topic':<{wide}}  {'type':<{wide_kind}}{'messages':>10}{'Hz':>9}")
    for name, kind, count, rate in rows:
        print(f"{name:<{wide}}  {kind:<{wide_kind}}{count:>10}{rate:>9}")


def _bytes(size: int) -> str:
    for unit, factor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if size >= factor:
            return f"{size / factor:.1f} {unit}"
    return f"{size} bytes"


@command(JSON)
def evaluate_run(args: argparse.Namespace) -> int:
    """Compare a trajectory with the truth, both in the TUM format.

    estimate EST           t x y z qx qy qz qw, T_odom_rig
    truth TRUTH            the same format, of the same rig frame in any world frame
    --tolerance-ms MS=10   largest difference between the stamps of two poses
    --align origin|rigid=origin  the first pose, as evo's --align_origin; rigid: all positions, as its --align
    --frame rig|auto=rig   the body whose truth it is: the rig; auto: fit three angles by which its axes are turned, and
        print them

    examples:
      eval est.txt truth.txt
      eval est.txt imu_truth.txt --frame auto
      eval est.txt truth.txt --align rigid --json
    """
    estimate, truth, tolerance_s = read_tum(args.estimate), read_tum(args.truth), args.tolerance_ms * 1e-3
    known: dict[str, object] = {}
    if args.frame == "auto":
        T_rig_body = turned_body(estimate, truth, tolerance_s)
        truth = Trajectory(truth.stamps_ns, truth.T @ se3.inverse(T_rig_body))
        turn_deg = np.rad2deg(se3.rotation_log(T_rig_body[:3, :3]))
        known["turned_deg"] = [round(float(angle), 2) for angle in turn_deg]
    metrics = evaluate(estimate, truth, tolerance_s, args.align)
    if args.json:
        print_json(asdict(metrics) | known)
        return 0
    if known:
        print(f"the truth is of a body turned by {known['turned_deg']} deg: fitted, so the errors are optimistic")
    print(metrics)
    return 0
