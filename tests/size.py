"""Measure the size of the project against its ceilings: `python -m tests.size`.

Ceilings stand in `tests/size.toml`. They fall when the project shrinks and are never raised silently: an addition names
what it replaces. Returns 1 where a figure is above its ceiling. `--lower` sets each ceiling to today's figure.

Numbers count twice. A *number at module level* is an assignment of a module whose value holds a numeric literal.
*Literals* are all numeric literals but -1, 0, 1, 2 and 0.5, by the place where they stand, so that a number that
moves from a module into a class, a default or a body stays in view.
"""

from __future__ import annotations

import ast
import statistics
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
CEILINGS = Path(__file__).with_name("size.toml")
PRODUCT = ("omnid", "drivers", "calib")
PLAIN_NUMBERS = (0, 1, 2, 0.5)
PLACES = ("module", "class", "default", "body")


@dataclass(slots=True)
class Size:
    """The size of a group of Python files."""

    files: int = 0
    lines: int = 0
    statements: int = 0
    numbers_at_module_level: int = 0
    literals: Counter[str] = field(default_factory=Counter)  # by place
    function_lines: list[int] = field(default_factory=list)

    def add(self, text: str) -> None:
        """Add one file."""
        tree = ast.parse(text)
        self.files += 1
        self.lines += text.count("\n")
        self.statements += sum(isinstance(node, ast.stmt) for node in ast.walk(tree))
        self.numbers_at_module_level += sum(map(is_number, tree.body))
        self.literals.update(literal_places(tree))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                self.function_lines.append((node.end_lineno or node.lineno) - node.lineno + 1)

    def figures(self) -> dict[str, int]:
        """Return the figures that have a ceiling."""
        return {
            "files": self.files,
            "lines": self.lines,
            "statements": self.statements,
            "numbers_at_module_level": self.numbers_at_module_level,
            **{f"literals_{place}": self.literals[place] for place in PLACES},
        }


def is_number(statement: ast.stmt) -> bool:
    """True if a statement of a module assigns a value with a numeric literal."""
    value = statement.value if isinstance(statement, ast.Assign | ast.AnnAssign) else None
    return value is not None and any(is_literal(node) for node in ast.walk(value))


def is_literal(node: ast.AST) -> bool:
    """True if a node is a numeric literal."""
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def literal_places(tree: ast.Module) -> list[str]:
    """Return the place of each numeric literal of a file that is none of PLAIN_NUMBERS."""
    places = []
    waiting: list[tuple[ast.AST, str]] = [(tree, "module")]
    while waiting:
        node, place = waiting.pop()
        if is_literal(node) and isinstance(node, ast.Constant) and node.value not in PLAIN_NUMBERS:
            places.append(place)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            defaults = {*node.args.defaults, *(value for value in node.args.kw_defaults if value)}
            waiting += [(value, "default") for value in defaults]
            waiting += [(below, "body") for below in ast.iter_child_nodes(node) if below is not node.args]
        else:
            inner = "class" if isinstance(node, ast.ClassDef) else place
            waiting += [(below, inner) for below in ast.iter_child_nodes(node)]
    return places


def tracked(*patterns: str) -> list[Path]:
    """Return the files under version control, or about to be, that match and exist."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [ROOT / name for name in sorted(set(names)) if (ROOT / name).exists()]


def measure(files: Iterable[Path]) -> Size:
    """Return the size of Python files."""
    size = Size()
    for path in files:
        size.add(path.read_text("utf-8"))
    return size


def main(arguments: list[str]) -> int:
    """Print each figure beside its ceiling; return 1 where one is above it."""
    ceilings = tomllib.loads(CEILINGS.read_text("utf-8"))
    apart = [ROOT / folder for folder in ceilings["apart"]]  # folders of experiments that are under way
    product = measure(
        path
        for path in tracked(*(f"{folder}/*.py" for folder in PRODUCT))
        if not any(path.is_relative_to(folder) for folder in apart)
    )
    tests = measure(tracked("tests/*.py"))
    words = sum(len(path.read_text("utf-8").split()) for path in tracked("*.md"))
    figures = {
        "product": product.figures(),
        "tests": {"files": tests.files, "lines": tests.lines},
        "documents": {"words": words},
    }
    above = 0
    for group, values in figures.items():
        for name, value in values.items():
            ceiling = ceilings[group][name]
            above += value > ceiling
            print(f"{group:10} {name:24} {value:8,} of {ceiling:8,}{'  TOO MANY' if value > ceiling else ''}")
    median = statistics.median(product.function_lines)
    share = product.statements / max(product.numbers_at_module_level, 1)
    print(f"{len(product.function_lines):,} functions of {median:g} lines (median); {share:.0f} statements a number")
    if "--lower" in arguments:
        CEILINGS.write_text(ceilings_text(figures, ceilings["apart"]), "utf-8")
    return int(above > 0)


def ceilings_text(figures: dict[str, dict[str, int]], apart: list[str]) -> str:
    """Return the text of `size.toml`."""
    folders = ", ".join(f'"{folder}"' for folder in apart)
    lines = [
        "# Ceilings of `python -m tests.size`; `--lower` sets them to the figures of the day.",
        f"apart = [{folders}]",
    ]
    for group, values in figures.items():
        lines += ["", f"[{group}]", *(f"{name} = {value}" for name, value in values.items())]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
