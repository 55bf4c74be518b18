"""Results of benchmarks as data: a table of figures in one JSON file, printed row by row as it is measured.

    table = ResultTable("accuracy", "accuracy", "Rendered logs", (Column("log"), Column("ATE rmse", "mm", 2)))
    table.add("rooms_s2", 0.19, seed=("rooms", 2))

The file is written after each row, so an interrupted run keeps its rows. It is NAME.json in the folder build/results;
the variable OMNID_RESULTS names another folder, or a file ending in .json. What is in tests/benchmark/results is shown
in docs/results (`python -m tests.benchmark.pages`).

    {"schema": 1, "question": "accuracy", "title": ..., "command": ..., "commit": ..., "machine": ..., "date": ...,
     "load": 0.4, "seeds": [{"family": "rooms", "seed": 2, "role": "development"}], "remarks": ["..."],
     "columns": [{"name": "log", "unit": "", "digits": null}, ...], "rows": [["rooms_s2", 0.19]]}

A cell is a number in the unit of its column, a text, true, false, or null where nothing was measured. load: processes
that wanted a processor in the minute before the start, null where it was not recorded. Without `digits` a number is
shown as it is.
"""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np

from tests.benchmark.reference_kernels import reference_ms
from tests.benchmark.seeds import family_and_seed, role_of

ROOT: Final = Path(__file__).parents[2]
PUBLISHED: Final = Path(__file__).with_name("results")
FOLDER_VARIABLE: Final = "OMNID_RESULTS"
SCHEMA: Final = 1
QUESTIONS: Final = ("accuracy", "calibration", "places", "obstacles", "driving", "light and skew", "speed", "faults")
KEYS: Final[dict[str, Any]] = {
    "schema": int,
    "question": str,
    "title": str,
    "command": str,
    "commit": str,
    "machine": str,
    "date": str,
    "load": (int, float, type(None)),
    "seeds": list,
    "remarks": list,
    "columns": list,
    "rows": list,
}
Cell: TypeAlias = float | int | str | bool | None
Seed: TypeAlias = tuple[str, int]  # family and number


class ResultError(ValueError):
    """A result that does not follow the schema."""


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
    """One table of figures; name: of its file."""

    name: str
    question: str
    title: str
    columns: Sequence[Column]
    remarks: Sequence[str] = ()
    rows: list[list[Cell]] = field(default_factory=list)
    seeds: list[Seed] = field(default_factory=list)
    date: str = field(default_factory=lambda: datetime.now(UTC).date().isoformat())
    load: float = field(default_factory=lambda: round(os.getloadavg()[0], 1))
    quiet: bool = False  # prints nothing
    continued: bool = False  # the first cell is a key: rows of other keys that the file has from this commit stay

    def __post_init__(self) -> None:
        if self.continued and self.path.exists():
            before = json.loads(self.path.read_text())
            if before["commit"] == commit():
                self.rows = before["rows"]
        self._print(f"| {' | '.join(column.head for column in self.columns)} |\n{'|---' * len(self.columns)}|")

    def add(self, *cells: Any, seed: Seed | None = None, folder: Path | None = None) -> None:
        """Append, print and save a row; seed, or the folder of a rendered log: what it was measured on."""
        if len(cells) != len(self.columns):
            raise ResultError(f"{self.name}: {len(self.columns)} cells were expected, {len(cells)} given")
        row = [_plain(cell) for cell in cells]
        self.rows = [*(old for old in self.rows if not self.continued or old[0] != row[0]), row]
        if folder is not None:
            seed = family_and_seed(folder.name)
        if seed is not None and seed not in self.seeds:
            self.seeds.append(seed)
        shown = (column.shown(cell) for column, cell in zip(self.columns, row, strict=True))
        self._print(f"| {' | '.join(shown)} |")
        self.save()

    def save(self) -> Path:
        """Write the file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(to_json(self.as_dict()))
        return self.path

    @property
    def path(self) -> Path:
        """The file."""
        place = Path(os.environ.get(FOLDER_VARIABLE, ROOT / "build" / "results"))
        return place if place.suffix == ".json" else place / f"{self.name}.json"

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the file."""
        seeds = [{"family": family, "seed": seed, "role": role_of(family, seed)} for family, seed in self.seeds]
        return {
            "schema": SCHEMA,
            "question": self.question,
            "title": self.title,
            "command": command(),
            "commit": commit(),
            "machine": machine() + (f", reference kernels {reference_ms():.0f} ms" if self.question == "speed" else ""),
            "date": self.date,
            "load": self.load,
            "seeds": seeds,
            "remarks": list(self.remarks),
            "columns": [asdict(column) for column in self.columns],
            "rows": self.rows,
        }

    def _print(self, text: str) -> None:
        if not self.quiet:
            print(text, flush=True)


def to_json(result: dict[str, Any]) -> str:
    """Return the text of a file: one line for each key, row, column and seed, so that changes are readable."""
    lines = []
    for key, value in result.items():
        if isinstance(value, list) and value:
            text = "[\n" + ",\n".join(f"  {json.dumps(part, ensure_ascii=False)}" for part in value) + "\n ]"
        else:
            text = json.dumps(value, ensure_ascii=False)
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def read_result(path: Path) -> dict[str, Any]:
    """Read and check a file; raises ResultError that names what does not follow the schema."""
    result = json.loads(path.read_text())
    fault = fault_of(result)
    if fault:
        raise ResultError(f"{path}: {fault}")
    return dict(result)


def fault_of(result: Any) -> str:
    """Return what does not follow the schema, or an empty text."""
    if not isinstance(result, dict) or set(result) != set(KEYS):
        return f"an object with the keys {', '.join(KEYS)} was expected"
    for key, kind in KEYS.items():
        if not isinstance(result[key], kind):
            return f"{key}: of another type"
    if result["schema"] != SCHEMA or result["question"] not in QUESTIONS:
        return f"schema {SCHEMA} and a question of {', '.join(QUESTIONS)} were expected"
    columns = [Column(**column) for column in result["columns"]]
    for row in result["rows"]:
        if len(row) != len(columns):
            return f"row {row}: {len(columns)} cells were expected"
        wrong = [cell for cell in row if not isinstance(cell, str | int | float | None)]
        if wrong:
            return f"row {row}: {wrong[0]} is no number, text, true, false or null"
    for seed in result["seeds"]:
        right = role_of(seed["family"], seed["seed"])
        if seed["role"] != right:
            return f"{seed['family']} {seed['seed']}: {seed['role']}, but seeds.toml says {right}"
    return ""


def _plain(cell: Any) -> Cell:
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


def command() -> str:
    """Return the command that runs: of a module, or of pytest; folders of this machine are DIR."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = spec.name.removesuffix(".__main__") if spec is not None else Path(sys.argv[0]).stem
    words = [re.sub(r"(^|[:=])/[^:=]*/", r"\1DIR/", word) for word in sys.argv[1:]]
    return shlex.join(["python", "-m", name, *words])


def commit() -> str:
    """Return the commit of the working tree, with a plus sign where files of the program differ from it."""
    words = ["git", "-C", str(ROOT)]
    try:
        name = subprocess.run([*words, "rev-parse", "--short=9", "HEAD"], capture_output=True, text=True, check=True)
        changed = subprocess.run(
            [*words, "status", "--porcelain", "--", "omnid", "calib", "drivers"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name.stdout.strip() + ("+" if changed.stdout.strip() else "")


def machine() -> str:
    """Return processor, cores and versions."""
    try:
        models = [
            line.partition(":")[2].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ]
    except OSError:
        models = []
    cores = os.cpu_count() or 1
    return (
        f"{cores} cores, {models[0] if models else platform.machine()}, Python {platform.python_version()}, "
        f"OpenCV {cv2.__version__}, numpy {np.__version__}"
    )
