"""Faults put into the code that moves the wheels: `python -m tests.faults.mutants` lists those that no test notices.

Each mutant changes one operator, number or word of a folder in a copy of the repository, where the tests that call
its function run (mutant_runner.py). Outcomes are kept in a file, so that a campaign may be stopped and go on later. A
mutant that survives is a missing test, or changes nothing that matters: a person judges it (docs/notes/faults.md).
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from tests.benchmark.results import Column, ResultTable

ROOT: Final = Path(__file__).parents[2]
COPIED: Final = ("omnid", "drivers", "calib", "tests", "systemd", "pyproject.toml")
SURVIVED: Final = "survived"
COLUMNS: Final = (
    Column("folder"),
    Column("mutants"),
    Column("tried"),
    Column("noticed"),
    Column("survived"),
    Column("unfinished, or ended by their time"),
)
NOTICED: Final = "noticed"
TIMEOUT: Final = "timeout"  # the process did not end by itself
UNFINISHED: Final = "unfinished"  # the limit of time was over before the last test: no test has failed so far
CONTROL_TESTS: Final = (
    "tests/omnid/core/control",
    "tests/omnid/controller",
    "tests/omnid/stages/test_lockstep_drive.py",
    "tests/omnid/transport/test_commands.py",
)
MOTOR_TESTS: Final = ("tests/drivers/motors", "tests/contract", "tests/omnid/controller/test_motor.py")
# The tests of each folder; those that show a page in a browser, and those that are slow, are not among them.
TESTS: Final[dict[str, tuple[str, ...]]] = {
    "omnid/core/control": CONTROL_TESTS,
    "omnid/controller": CONTROL_TESTS,
    "omnid/core/navigation": (
        "tests/omnid/core/navigation",
        "tests/omnid/stages/test_navigation.py",
        "tests/omnid/stages/test_navigation_random_walk.py",
    ),
    "omnid/transport/access.py": ("tests/omnid/transport",),
    "omnid/web": ("tests/omnid/web",),
    "drivers/motors": MOTOR_TESTS,
}
SWAPS: Final[dict[type[ast.AST], tuple[str, str]]] = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.BitOr: ("|", "&"),
    ast.BitAnd: ("&", "|"),
}
NAMES: Final = {"min": "max", "max": "min", "any": "all", "all": "any", "abs": "", "wrap_angle": ""}


class Mutant(NamedTuple):
    """A change of one place in a file."""

    path: str
    line: int
    start: int  # offset in the file's characters
    end: int
    text: str  # in its place

    def apply(self, source: str) -> str:
        """Return the changed source."""
        return source[: self.start] + self.text + source[self.end :]

    def described(self, source: str) -> str:
        """Return place and change in one line."""
        after = self.apply(source).splitlines()[self.line - 1].strip()
        return f"{self.path}:{self.line}: `{source.splitlines()[self.line - 1].strip()}` -> `{after}`"


class _Finder(ast.NodeVisitor):
    """Collects the mutants of one file; settings' declarations, annotations and texts are left alone."""

    def __init__(self, path: str, source: str) -> None:
        self._path, self._source = path, source
        self._starts = [0]
        for line in source.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line))
        self.found: list[Mutant] = []

    def visit_Call(self, node: ast.Call) -> None:
        """Exchange some functions by others."""
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name == "knob":
            return
        if name in NAMES:
            self._add(node.lineno, self._start(node.func), self._end(node.func), NAMES[name])
        self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """Visit the body only, not its decorators."""
        for statement in node.body:
            self.visit(statement)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        """Visit default values and the body, not the type of the result."""
        for part in (node.args, *node.body):
            self.visit(part)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Visit the value only."""
        if node.value is not None:
            self.visit(node.value)

    def visit_arguments(self, node: ast.arguments) -> None:
        """Visit default values only."""
        for default in (*node.defaults, *node.kw_defaults):
            if default is not None:
                self.visit(default)

    def visit_Compare(self, node: ast.Compare) -> None:
        """Exchange each comparison."""
        for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            self._swap(operator, left, right)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Exchange an operator."""
        self._swap(node.op, node.left, node.right)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """Exchange and, or."""
        self._swap(node.op, node.values[0], node.values[1])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """Leave out a sign or a not."""
        if isinstance(node.op, ast.Not | ast.USub):
            self._add(node.lineno, self._start(node), self._start(node.operand), "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """Change a number or a truth value."""
        if isinstance(node.value, bool):
            self._add(node.lineno, self._start(node), self._end(node), str(not node.value))
        elif isinstance(node.value, int | float):
            self._add(node.lineno, self._start(node), self._end(node), f"({node.value!r} + 1)")

    def _swap(self, operator: ast.AST, left: ast.AST, right: ast.AST) -> None:
        old, new = SWAPS.get(type(operator), ("", ""))
        start = self._end(left)
        at = self._source.find(old, start, self._start(right))
        if old and at >= 0:
            self._add(self._source.count("\n", 0, at) + 1, at, at + len(old), new)

    def _add(self, line: int, start: int, end: int, text: str) -> None:
        self.found.append(Mutant(self._path, line, start, end, text))

    def _start(self, node: ast.AST) -> int:
        return self._starts[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]

    def _end(self, node: ast.AST) -> int:
        return self._starts[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]


def mutants_of(path: str, source: str) -> list[Mutant]:
    """Return all mutants of a file that Python can compile."""
    finder = _Finder(path, source)
    finder.visit(ast.parse(source))
    return [mutant for mutant in finder.found if _compiles(mutant.apply(source))]


def all_mutants(folders: Sequence[str]) -> Iterator[Mutant]:
    """Yield the mutants of all files of the folders."""
    for folder in folders:
        whole = ROOT / folder
        for path in sorted(whole.rglob("*.py")) if whole.is_dir() else [whole]:
            yield from mutants_of(str(path.relative_to(ROOT)), path.read_text())


def _compiles(source: str) -> bool:
    try:
        compile(source, "mutant", "exec")
    except SyntaxError:
        return False
    return True


class Results:
    """Outcomes in a file of JSON lines, with which a later call goes on where this one was stopped."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.outcomes: dict[str, str] = {}
        if path.exists():
            rows = [json.loads(line) for line in path.read_text("utf-8").splitlines() if line.endswith("}")]
            self.outcomes = {row["mutant"]: row["outcome"] for row in rows}

    def add(self, mutant: str, outcome: str) -> None:
        """Keep the outcome of a mutant, named by its place and change."""
        self.outcomes[mutant] = outcome
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"mutant": mutant, "outcome": outcome}) + "\n")


def tests_of(folder: str) -> tuple[str, ...]:
    """Return the tests of a folder, or of the one that it is part of."""
    return next(tests for whole, tests in TESTS.items() if folder == whole or folder.startswith(f"{whole}/"))


def in_order(mutants: Mapping[str, Mutant]) -> dict[str, Mutant]:
    """Return the mutants by name, last those that differ only where two values are the same to the last digit.

    Most of these survive, which takes all tests.
    """

    def is_limit(name: str) -> bool:
        mutant = mutants[name]
        old = (ROOT / mutant.path).read_text("utf-8")[mutant.start : mutant.end]
        return {old, mutant.text} in ({"<", "<="}, {">", ">="})

    return {name: mutants[name] for name in sorted(mutants, key=is_limit)}


def try_mutants(tests: Sequence[str], mutants: Mapping[str, Mutant], limit_s: float, results: Path) -> None:
    """Try mutants with these tests in a copy of the repository; their outcomes are added to the results."""
    copy = results.with_suffix(".copy")
    shutil.rmtree(copy, ignore_errors=True)
    copy.mkdir(parents=True)
    try:
        for entry in COPIED:
            (shutil.copytree if (ROOT / entry).is_dir() else shutil.copy2)(ROOT / entry, copy / entry)
        asked = {"mutants": mutants, "tests": tests, "limit_s": limit_s, "results": str(results)}
        subprocess.run(
            [sys.executable, "-m", "tests.faults.mutant_runner"],
            cwd=copy,
            input=json.dumps(asked),
            text=True,
            check=True,
        )
    finally:
        shutil.rmtree(copy, ignore_errors=True)


def main() -> int:
    """Print the survivors of a sample of mutants of each folder, and how many there are."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.mutants", description=__doc__)
    parser.add_argument("folders", nargs="*", default=list(TESTS), help=f"or files in them; default: {' '.join(TESTS)}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=0, help="mutants of each folder to try; default: all")
    parser.add_argument("--limit-s", type=float, default=30.0, help="of the tests of one mutant; default: %(default)s")
    parser.add_argument(
        "--results",
        type=Path,
        default=Path("mutants.jsonl"),
        metavar="FILE",
        help="the outcomes so far; mutants in it are not tried again; default: %(default)s",
    )
    args = parser.parse_args()
    path = args.results.absolute()
    everything = {folder: list(all_mutants([folder])) for folder in args.folders}
    chosen: dict[str, dict[str, Mutant]] = {}
    for folder, mutants in everything.items():
        sample = random.Random(args.seed).sample(mutants, min(args.count or len(mutants), len(mutants)))
        chosen[folder] = {mutant.described((ROOT / mutant.path).read_text("utf-8")): mutant for mutant in sample}
    known = Results(path).outcomes
    missing: dict[tuple[str, ...], dict[str, Mutant]] = defaultdict(dict)
    for folder, named in chosen.items():
        missing[tests_of(folder)] |= {name: mutant for name, mutant in named.items() if name not in known}
    for tests, named in missing.items():
        if named:
            try_mutants(tests, in_order(named), args.limit_s, path)
    outcomes = Results(path).outcomes
    table = ResultTable("faults_mutants", "faults", "Mutants of the code", COLUMNS, continued=True)
    for folder, named in chosen.items():
        numbers = Counter(outcomes.get(name, "not tried") for name in named)
        tried = len(named) - numbers["not tried"]
        unfinished = numbers[UNFINISHED] + numbers[TIMEOUT]
        counts = (len(everything[folder]), tried, numbers[NOTICED], numbers[SURVIVED], unfinished)
        table.add(f"`{folder}`", *counts)
        print(
            "".join(f"  {outcomes[name]}: {name}\n" for name in named if outcomes.get(name) in (SURVIVED, UNFINISHED)),
            end="",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
