"""Tables of figures, printed row by row as they are measured, and written as JSON beside it.

    table = ResultTable("accuracy", "Rendered logs", (Column("log"), Column("ATE rmse", "mm", 2)))
    table.add("rooms_s2", 0.19, folder=Path("rooms_s2"))

The file is `build/results/NAME.json` (the variable OMNID_RESULTS names another folder). It is written after each row,
so an interrupted run keeps its rows, and it holds what the figures depend on: command, commit, machine, load, and the
seeds with their roles (`seeds.toml`). A cell is a number in the unit of its column, a text, true, false, or None where
nothing was measured.
"""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np

from tests.bench.reference_kernels import reference_ms
from tests.bench.seeds import family_and_seed, role_of

ROOT: Final = Path(__file__).parents[2]
Cell: TypeAlias = float | int | str | bool | None
Seed: TypeAlias = tuple[str, int]  # family and number


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
    if cell is None or isinstance(cell, str | bool):
        return cell
    if isinstance(cell, np.bool_):
        return bool(cell)
    if isinstance(cell, int | np.integer):
        return int(cell)
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
