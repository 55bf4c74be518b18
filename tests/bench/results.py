"""Tables of figures, and the one driver of all benchmarks: a function whose signature is its command line.

    def accuracy(folders: Sequence[Path], *, cloud: bool = False) -> None:
        table = ResultTable("accuracy", "Rendered logs", columns("log", "ATE rmse|mm|2"))
        table.add("rooms_s2", 0.19, folder=Path("rooms_s2"))

    if __name__ == "__main__":
        run(accuracy)

A row is printed as it is measured, and the table is written as `build/results/NAME.json` (the variable OMNID_RESULTS
names another folder) after each row, so an interrupted run keeps its rows. The file holds what the figures depend on:
command, commit, machine, load, and the seeds with their roles (`seeds.toml`). A cell is a number in the unit of its
column, a text, true, false, or None where nothing was measured.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal, TypeAlias, get_args, get_origin, get_type_hints

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.simulation.recipes import RECIPES

ROOT: Final = Path(__file__).parents[2]
Cell: TypeAlias = float | int | str | bool | None
Seed: TypeAlias = tuple[str, int]  # family and number
Image = NDArray[np.uint8]


def run(*measures: Callable[..., int | None]) -> None:
    """Call a benchmark with the words of the command line, and end with the code that it returns.

    Its signature is its command line. A parameter before the asterisk is a word, one after it an option of its name;
    Sequence[T] takes several, Literal has choices, False is a switch. Of several functions the first word names one.
    The help is the docstring of the module.
    """
    parser = argparse.ArgumentParser(
        description=inspect.getmodule(measures[0]).__doc__,  # type: ignore[union-attr]
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if len(measures) == 1:
        add_arguments(parser, measures[0])
    else:
        commands = parser.add_subparsers(required=True, metavar="|".join(measure.__name__ for measure in measures))
        for measure in measures:
            add_arguments(commands.add_parser(measure.__name__, help=measure.__doc__), measure)
    given = vars(parser.parse_args())
    chosen = given.pop("measure")
    sys.exit(chosen(**given))


def add_arguments(parser: argparse.ArgumentParser, measure: Callable[..., int | None]) -> None:
    """Add the parameters of a function to a parser."""
    hints = get_type_hints(measure)
    parser.set_defaults(measure=measure)
    for name, parameter in inspect.signature(measure).parameters.items():
        kind, words = hints[name], dict[str, Any]()
        if parameter.default is False:
            parser.add_argument(flag(name), action="store_true", dest=name)
            continue
        has_default = parameter.default is not inspect.Parameter.empty
        if get_origin(kind) is Sequence:
            kind, words = get_args(kind)[0], {"nargs": "*" if has_default else "+"}
            if parameter.default == ():
                words |= {"action": "extend"}
        if get_origin(kind) is Literal:
            kind, words = str, words | {"choices": get_args(kind)}
        if has_default:
            words["default"] = list(parameter.default) if "nargs" in words else parameter.default
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY:
            parser.add_argument(flag(name), type=kind, dest=name, required=not has_default, **words)
        else:
            parser.add_argument(name, type=kind, **words)


def flag(name: str) -> str:
    """Return the option of a parameter."""
    return "--" + name.rstrip("_").replace("_", "-")


@dataclass(frozen=True, slots=True)
class Column:
    """Name and unit of the figures in a column, and the digits behind the point that are shown."""

    name: str
    unit: str = ""
    digits: int | None = None

    @property
    def head(self) -> str:
        """Name with unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def shown(self, cell: Cell) -> str:
        """Return a cell as text."""
        if cell is None:
            return ""
        if isinstance(cell, bool):
            return "yes" if cell else "no"
        if isinstance(cell, str):
            return cell
        return f"{cell:,.{self.digits}f}" if self.digits is not None else f"{cell:,}"


def columns(*heads: str) -> tuple[Column, ...]:
    """Return columns, each of which is written as name|unit|digits; unit and digits may be left out."""
    parts = [f"{head}||".split("|") for head in heads]
    return tuple(Column(name, unit, int(digits) if digits else None) for name, unit, digits, *_ in parts)


@dataclass(slots=True)
class ResultTable:
    """One table of figures; name: of its file; timed: its figures are times, so it says how fast the machine was."""

    name: str
    title: str
    columns: Sequence[Column]
    remarks: Sequence[str] = ()
    timed: bool = False
    rows: list[list[Cell]] = field(default_factory=list)
    seeds: list[Seed] = field(default_factory=list)

    def add(self, *cells: Any, seed: Seed | None = None, folder: Path | None = None) -> None:
        """Append, print and save a row; seed, or the folder of a rendered log: what it was measured on."""
        row = [plain(cell) for cell in cells]
        if not self.rows:
            print(f"{self.title}\n| {' | '.join(column.head for column in self.columns)} |", flush=True)
            print("|---" * len(self.columns) + "|", flush=True)
        self.rows.append(row)
        seed = family_and_seed(folder.name) if folder is not None else seed
        if seed is not None and seed not in self.seeds:
            self.seeds.append(seed)
        shown = (column.shown(cell) for column, cell in zip(self.columns, row, strict=True))
        print(f"| {' | '.join(shown)} |", flush=True)
        path = Path(os.environ.get("OMNID_RESULTS", ROOT / "build" / "results")) / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.content(), indent=1, ensure_ascii=False))

    def content(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {
            "title": self.title,
            "command": shlex.join(["python", *sys.orig_argv[1:]]),
            "commit": commit(),
            "machine": machine() + (f", reference kernels {reference_ms():.0f} ms" if self.timed else ""),
            "date": datetime.now(UTC).date().isoformat(),
            "load": round(os.getloadavg()[0], 1),
            "seeds": [{"family": family, "seed": seed, "role": role_of(family, seed)} for family, seed in self.seeds],
            "remarks": list(self.remarks),
            "columns": [column.head for column in self.columns],
            "rows": self.rows,
        }


def plain(cell: Any) -> Cell:
    """Return a value of JSON; a number with seven digits, None for NaN, a text for infinity."""
    if cell is None or isinstance(cell, str | bool | int):
        return cell
    if isinstance(cell, np.bool_ | np.integer):
        return cell.item()  # type: ignore[no-any-return]
    number = float(cell)
    if math.isnan(number):
        return None
    return float(f"{number:.7g}") if math.isfinite(number) else str(number)


def commit() -> str:
    """Return the commit of the working tree, with a plus sign where files of the program differ from it."""
    words = ["git", "-C", str(ROOT)]
    try:
        name = subprocess.run([*words, "rev-parse", "--short=9", "HEAD"], capture_output=True, text=True, check=True)
        status = [*words, "status", "--porcelain", "--", "omnid", "calib", "drivers"]
        changed = subprocess.run(status, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name.stdout.strip() + ("+" if changed.stdout.strip() else "")


def machine() -> str:
    """Return the cores and the versions that figures depend on."""
    versions = f"Python {platform.python_version()}, OpenCV {cv2.__version__}, numpy {np.__version__}"
    return f"{os.cpu_count() or 1} cores, {platform.machine()}, {versions}"


# Roles of seeds: what was tuned on some is reported on others.

SEEDS: Final = Path(__file__).with_name("seeds.toml")


def role_of(family: str, seed: int) -> str:
    """Return the role of a seed by `seeds.toml`; a list of the family comes before one of all families."""
    tables = tomllib.loads(SEEDS.read_text())
    for table in (tables.get(family, {}), tables["any"]):
        for role, ranges in table.items():
            for text in ranges:
                first, _, last = text.partition("-")
                if int(first) <= seed <= int(last or first):
                    return str(role)
    return "development"


def family_and_seed(folder: str) -> Seed | None:
    """Return recipe and seed of a log's folder, named NAME_sSEED with any words between; None for another name."""
    found = re.fullmatch(r"(\w+?)_[a-z]?(\d+)", folder)
    names = [name for name in RECIPES if found and f"{found[1]}_".startswith(f"{name}_")]
    return (max(names, key=len), int(found[2])) if found and names else None


# How fast a machine is at the time of a measurement; a virtual machine changes by a factor of two within a day.

BLOCK_PX: Final = 5
LUCAS_KANADE: Final = cv2.calcOpticalFlowPyrLK  # not the one that is timed as a step


def sgbm_ns(lower: Image, upper: Image) -> int:
    """Return the processor time [ns] of one StereoSGBM on two panoramas (H, W)."""
    turned = [np.ascontiguousarray(image.T[:, ::-1]) for image in (lower, upper)]
    matcher = cv2.StereoSGBM.create(0, 128, BLOCK_PX, 8 * BLOCK_PX**2, 32 * BLOCK_PX**2)
    start_ns = time.thread_time_ns()
    matcher.compute(*turned)
    return time.thread_time_ns() - start_ns


def lucas_kanade_ns(before: Image, now: Image) -> int:
    """Return the processor time [ns] of tracking 500 corners from one panorama (H, W) to the next."""
    corners = cv2.goodFeaturesToTrack(before, 500, 0.001, 8)
    start_ns = time.thread_time_ns()
    LUCAS_KANADE(before, now, corners, None, winSize=(15, 15), maxLevel=3)
    return time.thread_time_ns() - start_ns


@cache
def reference_ms() -> float:
    """Return the processor time [ms] of both kernels on drawn panoramas of cameras of 768 px, in one thread."""
    texture = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (384, 1304), dtype=np.uint8), (0, 0), 2.0)
    texture = np.asarray(cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX), np.uint8)
    upper, later, threads = np.roll(texture, 12, axis=0), np.roll(texture, 5, axis=1), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return 1e-6 * median(sgbm_ns(texture, upper) + lucas_kanade_ns(texture, later) for _ in range(7))
    finally:
        cv2.setNumThreads(threads)
