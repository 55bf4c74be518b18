"""`omnid batch`: replay many logs by dask, on this machine or on a cluster, with one folder and one JSON a log.

Each log is replayed by programs of their own, so that nothing that a log does stops the others. The JSON is written
last, at once: a folder without it is done again.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from omnid.commands.options import CAMERAS, FILE_AND_SET, command, require, settings_of
from omnid.engine.process import python, python_environment
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.plain_text import one_line, plain
from omnid.version import __version__

RESULT_FILE = "result.json"
DONE = dict(enumerate(("ok", "no pose, or images lost")))  # by the exit code of `omnid replay`
OUTPUTS = ["--tum=est.txt", "--map-tum=map_est.txt", "--cloud=cloud.ply", "--plan=plan.png"]
# One thread for each program: as many programs run as there are cores.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}


@dataclass(frozen=True, slots=True)
class Job:
    """One log; all paths are absolute, because a worker may run elsewhere."""

    log: Path
    folder: Path  # of the results
    arguments: tuple[str, ...]  # of the program omnid
    truth: Path | None  # trajectory that the result is compared with
    fingerprint: str  # version of omnid, arguments, size and date of the log: a stored result must have the same


@command(CAMERAS, FILE_AND_SET)
def run(args: argparse.Namespace) -> int:
    """Replay many logs; goes on where it was interrupted (extra `fleet`). Exit code 1: a log failed.

    logs LOG...            files or folders
    --out DIR              a folder for each log with its result.json (required)
    --rig FILE             the rig.toml of all logs; default: that attached to each
    --truth NAME=truth.txt  trajectory beside each log, which is compared where it exists
    --jobs N 1..           logs at a time; default: the cores
    --scheduler ADDRESS    run on the workers of this dask scheduler, such as tcp://HOST:8786; they need omnid and the
        same paths

    examples:
      batch logs/ --out results --rig rig.toml
      batch logs/2026-*/*.mcap --out results --jobs 2
      batch logs/ --out results --scheduler tcp://HOST:8786
    """
    jobs = _jobs(args)
    results = {job: result for job in jobs if (result := _stored(job))}
    if results:
        print(f"{len(results)} of {len(jobs)} logs have their results already", file=sys.stderr)
    with _client(args.scheduler, args.jobs or os.cpu_count() or 1) as client:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        futures = {client.submit(replay, job, pure=False): job for job in jobs if job not in results}
        try:
            for future in import_module("distributed").as_completed(futures, raise_errors=False):
                is_done, job = future.status == "finished", futures[future]
                result = future.result() if is_done else {"status": "failed", "error": one_line(future.exception())}
                results[job] = result
                outcome = ": ".join(filter(None, (result["status"], result["error"])))
                print(f"{len(results)}/{len(jobs)}  {plain(str(job.folder))}: {outcome}", file=sys.stderr)
        finally:  # an interrupted batch leaves no programs
            for program in import_module("psutil").Process().children():
                program.terminate()
    counts = Counter(result["status"] for result in results.values())
    print(", ".join(f"{count} {status}" for status, count in counts.most_common()))
    return int(set(counts) != {DONE[0]})


def replay(job: Job) -> dict[str, Any]:
    """Replay a log, compare it with its truth, and return what its JSON holds; run by a worker."""
    started_s = time.monotonic()
    shutil.rmtree(job.folder, ignore_errors=True)
    job.folder.mkdir(parents=True)
    code, summary = _omnid(job.arguments, job)
    status, error = DONE.get(code, "failed"), ""
    if code not in DONE:
        lines = (job.folder / "messages.txt").read_text("utf-8", "replace").strip().splitlines()
        error = one_line(lines[-1]).removeprefix("omnid: ") if lines else f"exit code {code}"
    result = {"log": str(job.log), "fingerprint": job.fingerprint, "status": status, "error": error, "replay": summary}
    if code in DONE and job.truth is not None:
        result["eval"] = _omnid(("eval", "est.txt", str(job.truth), "--json"), job)[1]
    result["seconds"] = round(time.monotonic() - started_s, 3)
    write_whole(job.folder / RESULT_FILE, json.dumps(result, indent=1).encode() + b"\n")
    return result


def _omnid(arguments: Sequence[str], job: Job) -> tuple[int, Any]:
    """Run omnid in the folder of a job; return its exit code and the JSON that it printed."""
    command, environment = python("-m", "omnid", *arguments), python_environment(**ENVIRONMENT)
    with (job.folder / "messages.txt").open("ab") as messages:
        done = subprocess.run(command, cwd=job.folder, env=environment, stdout=subprocess.PIPE, stderr=messages)
    with suppress(ValueError):
        return done.returncode, json.loads(done.stdout)
    return done.returncode, None


def _jobs(args: argparse.Namespace) -> list[Job]:
    """Return the jobs of all logs; the folders of their results lie as the logs do below their common folder."""
    settings = settings_of(args)  # a mistake is reported now, and not by each log
    if settings.places.map and not settings.places.localize_only:
        raise OmnidError(
            "batch: each replay would extend places.map, so that results depend on their order: add "
            "--set places.localize_only=true, or make a map of all logs by `omnid map build`"
        )
    shared = [f"--{name}={path.absolute()}" for name in ("rig", "config") if (path := vars(args)[name])]
    shared += [f"--{name}={topic}" for name in ("lower", "upper") if (topic := vars(args)[name])]
    shared += [f"--set={value}" for value in args.set] + OUTPUTS
    logs = sorted({Path(os.path.abspath(log)) for path in args.logs for log in _below(path)})
    if not logs:
        raise OmnidError(f"batch: no log in {', '.join(map(str, args.logs))}")
    common = os.path.commonpath([log.parent for log in logs])
    jobs = []
    for log in logs:
        beside = (log if log.is_dir() else log.parent) / args.truth
        truth = beside if args.truth and beside.is_file() else None
        arguments = ("replay", str(log), *shared, "--inline", "--quiet", "--json")
        fingerprint = f"omnid {__version__} {' '.join(arguments)} {log.stat().st_size} {log.stat().st_mtime_ns}"
        jobs.append(Job(log, args.out.absolute() / log.relative_to(common), arguments, truth, fingerprint))
    return jobs


def _below(path: Path) -> Iterator[Path]:
    """Yield a file; a folder with the parts of one log or with folders of images; or the logs below a folder."""
    from drivers.logs.image_folder import image_folders
    from drivers.logs.log_reader import logs_in, parts_in_order

    if not path.is_dir():
        yield path
        return
    inside = logs_in(path)
    if len(parts_in_order(inside)) > 1:
        yield path
        return
    # Links to folders are not followed: they may form circles.
    folders = sorted(folder for folder in path.iterdir() if folder.is_dir() and not folder.is_symlink())
    found = [*inside, *(log for folder in folders for log in _below(folder))]
    yield from found or ([path] if len(image_folders(path)) > 1 else [])


def _stored(job: Job) -> dict[str, Any] | None:
    """Return the result of an earlier run of the same job, None without one."""
    try:
        result: dict[str, Any] = json.loads((job.folder / RESULT_FILE).read_text())
        return result if result["fingerprint"] == job.fingerprint and result["status"] in DONE.values() else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _client(scheduler: str | None, jobs: int) -> Any:
    """Return a client of an existing scheduler, or of threads in this process, each of which waits for programs."""
    require("fleet", "distributed")
    distributed = import_module("distributed")
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it reports each connection and repetition
    if not scheduler:
        # dask has web servers in any case, by default for all machines of the network.
        warnings.simplefilter("ignore", RuntimeWarning)  # it looks for this machine's address, also without network
        here = dict.fromkeys(("dashboard_address", "worker_dashboard_address"), "127.0.0.1:0")
        return distributed.Client(processes=False, n_workers=1, threads_per_worker=jobs, **here)
    try:
        return distributed.Client(scheduler, timeout="10 s")
    except (OSError, TimeoutError, ValueError) as error:
        raise OmnidError(f"no dask scheduler answers at {scheduler!r}: {one_line(error)}") from error
