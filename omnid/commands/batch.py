"""`omnid batch`: replay many logs by dask, on this machine or on a cluster, with one folder and one JSON a log.

Each log is replayed by programs of their own, so that nothing that a log does stops the others. Their results are
written into a temporary folder that takes its place at the end: a program that was killed leaves no half result.
"""

from __future__ import annotations

import argparse
import glob
import hashlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from omnid.commands.options import CONFIG, SET, cameras, command, option, settings_of
from omnid.engine.process import python, python_environment
from omnid.errors import OmnidError
from omnid.plain_text import one_line, plain
from omnid.version import __version__

RESULT_FILE, RECORDING = "result.json", "recording.mcap"
DONE = {0: "ok", 1: "no pose"}  # by the exit code of `omnid replay`
OUTPUTS = (("--tum", "est.txt"), ("--map-tum", "map_est.txt"), ("--cloud", "cloud.ply"), ("--plan", "plan.png"))
# One thread for each program: as many programs run as there are cores.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}


@dataclass(frozen=True, slots=True)
class Job:
    """One log; all paths are absolute, because a worker may run elsewhere."""

    log: Path
    folder: Path  # of the results
    words: tuple[str, ...]  # of `omnid replay`
    truth: Path | None  # trajectory that the result is compared with
    timeout_s: float
    key: str  # digest of all that makes the result


@command(
    option("logs", nargs="+", metavar="LOG", help="files, folders, or patterns in quotes"),
    option("--out", type=Path, required=True, metavar="DIR", help=f"a folder for each log with its {RESULT_FILE}"),
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
    option("--jobs", type=int, default=os.cpu_count(), metavar="N", help="logs at a time; default: the cores"),
    option(
        "--scheduler",
        metavar="ADDRESS",
        help="run on the workers of this dask scheduler, such as tcp://HOST:8786; they need omnid and the same paths",
    ),
    option("--timeout-s", type=float, default=3600.0, metavar="S", help="for one log; default %(default)g"),
    examples=(
        "batch logs/ --out results --rig rig.toml",
        "batch 'logs/2026-*/*.mcap' --out results --jobs 2 --record",
        "batch logs/ --out results --scheduler tcp://HOST:8786",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Run the jobs that have no result yet; return 1 where a log failed."""
    if args.jobs < 1 or not 0 < args.timeout_s <= 1e6:  # the system waits for a program at most 2^31 ms
        raise OmnidError("batch: expected --jobs of 1 or more, and --timeout-s above 0 and up to 1e6")
    jobs = _jobs(args)
    results = {job: result for job in jobs if (result := _stored(job))}
    if results:
        print(f"{len(results)} of {len(jobs)} logs have their results already", file=sys.stderr)
    with _client(args.scheduler, args.jobs) as client:
        signal.signal(signal.SIGTERM, _interrupt)
        due = [job for job in jobs if job not in results]
        futures = {client.submit(replay, job, pure=False, retries=1): job for job in due}
        try:
            for future in import_module("distributed").as_completed(futures, raise_errors=False):
                job = futures[future]
                finished = future.status == "finished"
                result = future.result() if finished else {"status": "failed", "error": one_line(future.exception())}
                results[job] = result
                outcome = ": ".join(filter(None, (result["status"], result["error"])))
                print(f"{len(results)}/{len(jobs)}  {plain(str(job.folder))}: {outcome}", file=sys.stderr)
        finally:
            _end_programs()
    counts = Counter(result["status"] for result in results.values())
    print(", ".join(f"{count} {status}" for status, count in counts.most_common()))
    return int(set(counts) != {DONE[0]})


def replay(job: Job) -> dict[str, Any]:
    """Replay a log, compare it with its truth, and return what its JSON holds; run by a worker.

    Raise RuntimeError where the program was killed, so that dask tries once more.
    """
    started_s = time.monotonic()
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    attempt = Path(tempfile.mkdtemp(prefix=".attempt-", dir=job.folder.parent))
    try:
        code, summary = _omnid(job.words, attempt, job.timeout_s)
        if code is not None and code < 0:
            raise RuntimeError(f"{job.log}: the program was ended by signal {-code}")
        lines = (attempt / "messages.txt").read_text("utf-8", "replace").strip().splitlines()
        result: dict[str, Any] = {"log": str(job.log), "key": job.key, "status": "failed", "error": ""}
        if code in (0, 1):
            result["status"] = DONE[code]
        else:
            last = one_line(lines[-1]).removeprefix("omnid: ") if lines else f"exit code {code}"
            result["error"] = f"more than {job.timeout_s:g} s" if code is None else last
        result["replay"] = summary
        if code == 0 and job.truth is not None:
            result["eval"] = _omnid(("eval", "est.txt", str(job.truth), "--json"), attempt, job.timeout_s)[1]
        if code == 0 and RECORDING in job.words:
            _omnid(("report", RECORDING, "-o", "report.html"), attempt, job.timeout_s)
        result["seconds"] = round(time.monotonic() - started_s, 3)
        (attempt / RESULT_FILE).write_text(json.dumps(result, indent=1) + "\n")
        attempt.chmod(0o755)  # that of a temporary folder is for its owner only
        shutil.rmtree(job.folder, ignore_errors=True)
        os.replace(attempt, job.folder)
        return result
    finally:
        shutil.rmtree(attempt, ignore_errors=True)


def _omnid(words: Sequence[str], folder: Path, timeout_s: float) -> tuple[int | None, Any]:
    """Run omnid in a folder; return its exit code (None: it took too long) and the JSON that it printed, if any."""
    with (folder / "messages.txt").open("ab") as messages:
        environment = python_environment(**ENVIRONMENT)
        command = python("-m", "omnid", *words)
        program = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=messages)
        try:
            text, _ = program.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            program.terminate()  # which stops the wheels and leaves no file half written
            program.wait()
            return None, None
    with suppress(ValueError):
        return program.returncode, json.loads(text)
    return program.returncode, None


def _jobs(args: argparse.Namespace) -> list[Job]:
    """Return the jobs of all logs; the folders of their results lie as the logs do below their common folder."""
    settings = settings_of(args)  # a mistake is reported now, and not by each log
    if settings.places.map and not settings.places.localize_only:
        raise OmnidError(
            "batch: each replay would extend places.map, so that results depend on their order: add "
            "--set places.localize_only=true, or make a map of all logs by `omnid map build`"
        )
    if args.out.exists() and not args.out.is_dir():
        raise OmnidError(f"batch: --out {str(args.out)!r}: expected a folder for the results, found a file")
    options = [("--rig", args.rig and args.rig.absolute()), ("--config", args.config and args.config.absolute())]
    options += [("--lower", args.lower), ("--upper", args.upper), *(("--set", value) for value in args.overrides)]
    options += [("--record", RECORDING if args.record else None), *OUTPUTS]
    given = tuple(str(word) for option in options if option[1] is not None for word in option)
    named = [Path(path) for name in args.logs for path in glob.glob(name, recursive=True) or [name]]
    logs = sorted({Path(os.path.abspath(log)) for path in named for log in _below(path)})
    if not logs:
        raise OmnidError(f"batch: no log in {', '.join(args.logs)}; give files, folders, or patterns in quotes")
    common = os.path.commonpath([log.parent for log in logs])
    known_map = Path(settings.places.map) if settings.places.map else None
    jobs = []
    for log in logs:
        beside = (log if log.is_dir() else log.parent) / args.truth
        truth = beside if args.truth and beside.is_file() else None
        words = ("replay", str(log), *given, "--inline", "--quiet", "--json")
        inputs = [path for path in (log, truth, args.rig, args.config, known_map) if path]
        files = [file for path in inputs for file in (sorted(path.rglob("*")) if path.is_dir() else [path])]
        stats = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
        key = hashlib.sha256(json.dumps([__version__, words, str(truth), stats]).encode()).hexdigest()
        jobs.append(Job(log, args.out.absolute() / log.relative_to(common), words, truth, args.timeout_s, key))
    return jobs


def _below(path: Path) -> Iterator[Path]:
    """Yield a file; a folder with the parts of one log or with folders of images; or the logs below a folder."""
    from drivers.logs.image_folder import image_folders
    from drivers.logs.open_log import logs_in, parts_in_order

    if not path.is_dir():
        yield path
        return
    inside = logs_in(path)
    if len(inside) > 1 and parts_in_order(inside):
        yield path
        return
    # Links to folders are not followed: they may form circles.
    folders = sorted(folder for folder in path.iterdir() if folder.is_dir() and not folder.is_symlink())
    found = [*inside, *(log for folder in folders for log in _below(folder))]
    yield from found or ([path] if len(image_folders(path)) > 1 else [])


def _stored(job: Job) -> dict[str, Any] | None:
    """Return the result of an earlier run of the same job, None without one. Raise OmnidError for another log's."""
    try:
        result: dict[str, Any] = json.loads((job.folder / RESULT_FILE).read_text())
        log, is_done = result["log"], result["key"] == job.key and result["status"] in DONE.values()
    except (OSError, ValueError, TypeError, KeyError):
        return None
    if log != str(job.log):
        raise OmnidError(f"batch: {str(job.folder)!r} has the results of {log!r}: give another --out")
    return result if is_done else None


def _client(scheduler: str | None, jobs: int) -> Any:
    """Return a client of an existing scheduler, or of threads in this process, each of which waits for programs."""
    try:
        distributed = import_module("distributed")
    except ImportError as error:
        raise OmnidError(f"batch needs dask.distributed: install the extra `fleet` into {sys.prefix}") from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # each connection and repetition is told
    if not scheduler:
        here = "127.0.0.1:0"  # dask has web servers in any case, by default for all machines of the network
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # it looks for this machine's address, also without network
            return distributed.Client(
                processes=False,
                n_workers=1,
                threads_per_worker=jobs,
                dashboard_address=here,
                worker_dashboard_address=here,
            )
    try:
        return distributed.Client(scheduler, timeout="10 s")
    except (OSError, TimeoutError, ValueError) as error:
        raise OmnidError(f"no dask scheduler answers at {scheduler!r}: {one_line(error)}") from error


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def _end_programs() -> None:
    """End the programs of this process, so that an interrupted batch leaves none."""
    for program in import_module("psutil").Process().children():
        program.terminate()
