"""One job: `omnid replay` and `omnid eval` in programs of their own, so that nothing that a log does stops the others.

The results are written into a folder of the attempt, which takes its place at the end: a program that was killed
leaves nothing that looks like a result.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from drivers.logs.log_formats import LOG_SUFFIXES
from omnid.batch.jobs import RESULT_FILE, Job, file_system, is_url
from omnid.batch.programs import messages, run_omnid
from omnid.plain_text import one_line

_ATTEMPT: Final = ".attempt-"
_FETCHED: Final = "fetched"  # name of a log from an address, without its suffix

MAX_ATTEMPTS: Final = 2  # A job whose program was killed is attempted this often.
OK, NO_POSE, FAILED, KILLED, TIMED_OUT = "ok", "no pose", "failed", "killed", "timed out"


@dataclass(frozen=True, slots=True)
class JobResult:
    """A row of the table. Numbers of a log that failed are NaN or 0."""

    name: str
    log: str
    status: str = FAILED  # one of the constants above
    error: str = ""
    seconds: float = 0.0
    attempts: int = 1
    pairs: int = 0
    poses: int = 0
    length_m: float = math.nan
    tracking: int = 0
    degraded: int = 0
    lost: int = 0
    resets: int = 0
    dropped: int = 0
    warnings: int = 0
    length_error_ratio: float = math.nan  # of the truth, as the next three
    ate_rmse_m: float = math.nan
    end_error_m: float = math.nan
    heading_max_rad: float = math.nan
    key: str = field(default="", repr=False)  # of the job


@dataclass(frozen=True, slots=True)
class JobTask:
    """A job for a worker."""

    job: Job

    def run(self) -> JobResult:
        """Run it, again where its program was killed; an error of the machine, such as a full disk, is its result."""
        result = self.failed("")
        for attempt in range(1, MAX_ATTEMPTS + 1):
            try:
                result = replace(run_job(self.job), attempts=attempt)
            except OSError as error:
                result = replace(self.failed(one_line(error)), attempts=attempt)
            if result.status != KILLED:
                break
        return result

    def failed(self, error: str) -> JobResult:
        """Return the result of a job that could not be run."""
        return JobResult(self.job.name, self.job.log, FAILED, error)


def run_job(job: Job) -> JobResult:
    """Run a job and return its result, which is also in its folder; never raises for what a log contains.

    Raise BatchInterrupted after `end_programs`: then there is no result.
    """
    started_s, key = time.monotonic(), job.key()  # of the files as they are now: they may change while it runs
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    attempt = Path(tempfile.mkdtemp(prefix=f"{_ATTEMPT}{job.folder.name}-", dir=job.folder.parent))
    try:
        values = _attempt(job, attempt)
        result = JobResult(
            name=job.name, log=job.log, seconds=round(time.monotonic() - started_s, 3), key=key, **values
        )
        (attempt / RESULT_FILE).write_text(json.dumps(row_values(result), indent=1) + "\n")
        _replace(attempt, job.folder)
        return result
    finally:
        shutil.rmtree(attempt, ignore_errors=True)


def stored_result(job: Job) -> JobResult | None:
    """Return the result of an earlier run of the same job, None without one or where it failed."""
    try:
        stored: dict[str, Any] = json.loads((job.folder / RESULT_FILE).read_text())
        values: dict[str, Any] = {name: math.nan if value is None else value for name, value in stored.items()}
        result = JobResult(**values)
    except (OSError, ValueError, TypeError, AttributeError):
        return None
    return result if result.key == job.key() and result.status in (OK, NO_POSE) else None


def row_values(result: JobResult) -> dict[str, Any]:
    """Return a row by names, with None in place of NaN."""
    values = {name: getattr(result, name) for name in JobResult.__slots__}
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}


def _attempt(job: Job, folder: Path) -> dict[str, Any]:
    """Return the values of a row without name, log, time and key."""
    try:
        log = _local(job.log, folder)
    except Exception as error:  # any of the many that the file systems raise
        return {"status": FAILED, "error": one_line(error)}
    outputs = ["--tum", "est.txt", "--map-tum", "map_est.txt", "--cloud", "cloud.ply", "--plan", "plan.png"]
    if job.options.record:
        outputs += ["--record", "recording.mcap"]
    code, text = run_omnid(
        ["replay", str(log), *job.options.arguments, *outputs, "--inline", "--quiet", "--json"],
        folder,
        job.options.timeout_s,
    )
    values = _failure(code, folder) | _counters(text)
    if code == 0 and (truth := job.truth()) is not None:
        values |= _compared(folder, truth, job.options.timeout_s)
    if code in (0, 1) and job.options.record:
        run_omnid(["report", "recording.mcap", "-o", "report.html"], folder, job.options.timeout_s)
    if is_url(job.log):
        log.unlink(missing_ok=True)
    return values


def _local(log: str, folder: Path) -> Path:
    """Return the path of a log; one at an address is fetched into the folder.

    Its name there is not that of the object, which a stranger may have chosen: the folder is where programs run.
    """
    if not is_url(log):
        return Path(log)
    suffix = next((suffix for suffix in LOG_SUFFIXES if log.endswith(suffix)), LOG_SUFFIXES[0])
    path = folder / f"{_FETCHED}{suffix}"
    file_system(log).get_file(log, str(path))
    return path


def remove_attempts(out: Path) -> None:
    """Remove what programs that were killed have left in the folder of a batch."""
    for left in out.glob(f"{_ATTEMPT}*"):
        shutil.rmtree(left, ignore_errors=True)


def _failure(code: int | None, folder: Path) -> dict[str, Any]:
    """Return status, error and number of warnings of a replay with this exit code; None: it took too long."""
    lines, problem = messages(folder), ""
    if code is not None and code < 0:
        status, problem = KILLED, f"the program ended by signal {-code}"
    else:
        status = {0: OK, 1: NO_POSE, None: TIMED_OUT}.get(code, FAILED)
        if lines and status not in (OK, NO_POSE):
            problem = one_line(lines[-1]).removeprefix("omnid: ")
    return {"status": status, "error": problem, "warnings": sum(": warning: " in line for line in lines)}


def _counters(text: str) -> dict[str, Any]:
    """Return the values of the summary that a replay prints as JSON; none of one that printed no summary."""
    try:
        counters = json.loads(text)["counters"]
        return {
            "pairs": counters["pairs"],
            "poses": counters["poses"],
            "length_m": _number(counters["length_m"]),
            **counters["states"],
            "resets": counters["resets"],
            "dropped": sum(counters["drops"].values()),
        }
    except (ValueError, KeyError, TypeError):
        return {}


def _compared(folder: Path, truth: Path, timeout_s: float) -> dict[str, Any]:
    """Return the errors against the truth; where they cannot be computed, the messages say why."""
    _, text = run_omnid(["eval", "est.txt", str(truth), "--json"], folder, timeout_s)
    with suppress(ValueError, KeyError, TypeError):
        found = json.loads(text)
        return {
            name: _number(found[name])
            for name in ("length_error_ratio", "ate_rmse_m", "end_error_m", "heading_max_rad")
        }
    return {}


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _replace(new: Path, folder: Path) -> None:
    """Put a folder in the place of another one."""
    if folder.exists():
        old = Path(tempfile.mkdtemp(prefix=f"{_ATTEMPT}old-", dir=folder.parent))
        os.replace(folder, old / "folder")
        shutil.rmtree(old, ignore_errors=True)
    os.replace(new, folder)
    folder.chmod(0o755)  # that of a temporary folder is for its owner only
