"""`omnid batch`: replay many logs, on this machine or on a dask cluster, into one folder with one table."""

from __future__ import annotations

import argparse
import fcntl
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from omnid.commands.options import CONFIG, SET, cameras, command, option, settings_of
from omnid.commands.worker_options import end_by_sigterm, program_options, workers
from omnid.errors import OmnidError

if TYPE_CHECKING:
    from omnid.batch.jobs import BatchOptions

LOCK_FILE = ".lock"
# Longest time for one log: eleven days, far beyond any. The system waits for a program at most 2^31 ms.
MOST_S = 1e6
TABLES_S = 5.0  # shortest time from one writing of the tables to the next, before the end


@command(
    option(
        "logs",
        nargs="+",
        metavar="LOG",
        help="files, folders, patterns in quotes, or addresses such as s3://bucket/*.mcap (extra `fleet`)",
    ),
    option(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="a folder for each log, and results.csv, index.html, and results.parquet where pyarrow is installed, of "
        "the logs of the last batch",
    ),
    option("--rig", type=Path, help="the rig.toml of all logs; default: that attached to each"),
    *cameras(),
    CONFIG,
    SET,
    option(
        "--truth",
        default="truth.txt",
        metavar="NAME",
        help="trajectory beside each log, which is compared where it exists; default %(default)s",
    ),
    option("--record", action="store_true", help="keep a recording and a report of each log"),
    *workers("logs at a time on this machine", os.cpu_count() or 1),
    option("--timeout-s", type=float, default=3600.0, metavar="S", help="for one log; default %(default)g"),
    examples=(
        "batch logs/ --out results --rig rig.toml",
        "batch 'logs/2026-*/*.mcap' --out results --jobs 2 --record",
        "batch s3://bucket/*.mcap --out results --dask tcp://scheduler:8786",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Run the jobs that have no result yet; return 1 where a log failed."""
    from omnid.batch.job_runner import OK, JobTask, remove_attempts, stored_result
    from omnid.batch.jobs import find_logs, jobs
    from omnid.batch.tables import write_tables
    from omnid.batch.workers import workers_of
    from omnid.plain_text import plain

    if not 0 < args.timeout_s <= MOST_S:
        raise OmnidError(f"batch: --timeout-s {args.timeout_s:g}: expected seconds above 0 and up to {MOST_S:.0f}")
    logs, options = find_logs(args.logs), _options(args)
    end_by_sigterm()
    with workers_of(args.jobs, args.dask) as workers, _locked(args.out):
        remove_attempts(args.out)
        all_jobs = jobs(logs, args.out.absolute(), options)
        stored = {job.name: result for job in all_jobs if (result := stored_result(job)) is not None}
        if stored:
            print(f"{len(stored)} of {len(all_jobs)} logs have their results already", file=sys.stderr)
        results, next_s = dict(stored), 0.0
        for result in workers([JobTask(job) for job in all_jobs if job.name not in stored]):
            results[result.name] = result
            outcome = result.error if result.status != OK else f"{result.length_m:.3f} m"
            print(
                f"{len(results)}/{len(all_jobs)}  {result.name}: {result.status}, {outcome}, {result.seconds:.1f} s",
                file=sys.stderr,
            )
            if time.monotonic() > next_s:
                write_tables(list(results.values()), args.out)
                next_s = time.monotonic() + TABLES_S
        written = write_tables(list(results.values()), args.out)
    counts = Counter(result.status for result in results.values())
    print(", ".join(f"{count} {status}" for status, count in counts.most_common()))
    print("\n".join(plain(str(path)) for path in written))
    return int(set(counts) != {OK})


def _options(args: argparse.Namespace) -> BatchOptions:
    from omnid.batch.jobs import BatchOptions, input_files

    config = settings_of(args)  # a mistake is reported now, and not by each log
    paths, topics = {"--rig": args.rig, "--config": args.config}, {"--lower": args.lower, "--upper": args.upper}
    inputs = input_files(args.rig, args.config, config.places)
    arguments = program_options(paths, topics, args.overrides)
    return BatchOptions(tuple(arguments), args.truth, args.record, args.timeout_s, inputs)


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Keep other batches out of a folder, which is created."""
    if out.exists() and not out.is_dir():
        raise OmnidError(f"batch: --out {str(out)!r}: expected a folder for the results, found a file")
    out.mkdir(parents=True, exist_ok=True)
    with (out / LOCK_FILE).open("wb") as file:
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OmnidError(
                f"batch: another batch writes into {str(out)!r}; wait for it, or give another --out"
            ) from error
        yield
