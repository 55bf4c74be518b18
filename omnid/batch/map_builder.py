"""A map of many drives: a map of each log, made side by side, and these joined pair by pair.

Each program writes one map. Maps are joined in rounds, those of one round side by side: each with the next one that it
has not been tried with. Two that share no place stay apart until others join them, so that drives of one region come
together first; the frame of the result is that of the first log.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from omnid.batch.programs import messages, run_omnid
from omnid.batch.workers import Workers
from omnid.core.places.merge import NO_COMMON_PLACE
from omnid.errors import OmnidError
from omnid.plain_text import one_line

TIMEOUT_S: Final = 6 * 3600.0  # for one program
MAX_ATTEMPTS: Final = 2  # A program that was killed is attempted this often.
WARNING: Final = "omnid: warning: "

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class MapResult:
    """Outcome of one program."""

    task: MapTask
    error: str = ""  # one line; empty: the program did its work
    is_empty: bool = False  # a log has no keyframe, and there is no map
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class MapTask:
    """A program that writes a map, for a worker. Paths are absolute."""

    what: str  # in a few words
    words: tuple[str, ...]  # of omnid, without the output
    output: Path

    def run(self) -> MapResult:
        """Run it in a folder beside the output, again where it was killed."""
        folder = self.output.with_suffix("")
        folder.mkdir(exist_ok=True)
        started_s, code = time.monotonic(), None
        for _ in range(MAX_ATTEMPTS):
            code, _ = run_omnid([*self.words, "-o", str(self.output)], folder, TIMEOUT_S)
            if code is None or code >= 0:
                break
        lines = messages(folder)
        warnings = tuple(line.removeprefix(WARNING) for line in lines if line.startswith(WARNING))
        error = ""
        if code != 0:
            problem = "it took too long" if code is None else f"the program ended with code {code}"
            error = lines[-1].removeprefix("omnid: ") if lines and code == 2 else problem
        is_empty = code == 1
        return MapResult(self, "" if is_empty else one_line(error), is_empty, warnings, time.monotonic() - started_s)

    def failed(self, error: str) -> MapResult:
        """Return the result for a worker that was lost."""
        return MapResult(self, error)


@dataclass(frozen=True, slots=True)
class _Part:
    """A map of some of the logs."""

    path: Path
    names: tuple[str, ...]  # of its logs


def build_map(
    logs: Sequence[Path], options: Sequence[str], first: Path | None, folder: Path, workers: Workers, report: Report
) -> Path | None:
    """Return the map of all logs, in a folder that the workers reach, too; None: no log has a keyframe.

    options: of `omnid map build`, for each log; first: a map that is extended, None: there is none. Raises OmnidError
    where a program fails, or a log shares no place with the others.
    """
    parts = _maps_of_logs(logs, options, folder, workers, report)
    if first is not None:
        parts.insert(0, _Part(first, (str(first),)))
    return _joined(parts, folder, workers, report).path if parts else None


def _maps_of_logs(
    logs: Sequence[Path], options: Sequence[str], folder: Path, workers: Workers, report: Report
) -> list[_Part]:
    """Return a map of each log that has a keyframe."""
    tasks = [
        MapTask(str(log), ("map", "build", str(log.absolute()), *options, "--quiet"), folder / f"{number}.omap")
        for number, log in enumerate(logs)
    ]
    results = _run(tasks, workers, report)
    if failed := [result for result in results if result.error]:
        log, error = failed[0].task.what, failed[0].error
        raise OmnidError(f"map build: {error if log in error else f'{log}: {error}'}")
    empty = {result.task.output for result in results if result.is_empty}
    return [_Part(task.output, (task.what,)) for task in tasks if task.output not in empty]


def _joined(parts: list[_Part], folder: Path, workers: Workers, report: Report) -> _Part:
    """Return one map of one or more, joined in rounds of pairs. Raise OmnidError where some share no place."""
    tried, number = set[tuple[Path, Path]](), len(parts)
    while len(parts) > 1:
        pairs = _pairs(parts, tried)
        if not pairs:
            apart = ", ".join(part.names[0] for part in parts[1:])
            raise OmnidError(
                f"map build: {apart}: {NO_COMMON_PLACE} with {parts[0].names[0]} that is recognised: add a log of a "
                "drive through both, or build a map of each"
            )
        joined = {}
        for a, b in pairs:
            tried.add((a.path, b.path))
            output = folder / f"{number}.omap"
            words = "map", "merge", str(a.path.absolute()), str(b.path.absolute())
            joined[MapTask(f"{len(a.names)} + {len(b.names)} logs", words, output)] = a, b
            number += 1
        for result in _run(list(joined), workers, report):
            a, b = joined[result.task]
            if not result.error:
                whole = _Part(result.task.output, a.names + b.names)
                parts = [whole if part is a else part for part in parts if part is not b]
            elif NO_COMMON_PLACE not in result.error:
                raise OmnidError(f"map build: {result.error}")
    return parts[0]


def _pairs(parts: Sequence[_Part], tried: set[tuple[Path, Path]]) -> list[tuple[_Part, _Part]]:
    """Return pairs of maps to join side by side: each with the next one that it has not been tried with."""
    pairs, taken = [], set[Path]()
    for number, part in enumerate(parts):
        others = (
            other for other in parts[number + 1 :] if other.path not in taken and (part.path, other.path) not in tried
        )
        if part.path not in taken and (other := next(others, None)) is not None:
            pairs.append((part, other))
            taken |= {part.path, other.path}
    return pairs


def _run(tasks: Sequence[MapTask], workers: Workers, report: Report) -> list[MapResult]:
    """Return the results of tasks; each is reported as it comes."""
    results = []
    for result in workers(tasks):
        results.append(result)
        for warning in result.warnings:
            report(f"{WARNING}{warning}")
        outcome = result.error or "no keyframe" * result.is_empty or f"{result.seconds:.1f} s"
        report(f"{len(results)}/{len(tasks)}  {result.task.what}: {outcome}")
    return results
