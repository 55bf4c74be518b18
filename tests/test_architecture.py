"""The layers hold: imports point one way, and threads and clocks stay where they belong."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True)
class Rule:
    """No file in a folder imports any of the modules, some files excepted."""

    folder: str
    forbidden: tuple[str, ...]
    excepted: tuple[str, ...] = ()


RULES = (
    Rule("calib", ("omnid", "drivers", "threading", "_thread", "time", "socket")),
    Rule("drivers", ("omnid", "calib")),
    Rule("omnid", ("threading", "_thread"), excepted=("omnid/engine/graph.py",)),
    Rule(
        "omnid/core",
        ("threading", "time", "logging", "omnid.stages", "omnid.transport", "omnid.engine", "omnid.cli"),
    ),
    Rule("omnid/stages", ("threading", "time")),
)


def imported(path: Path, root: Path) -> Iterator[str]:
    """Full names of everything that a file imports, at its top or within functions."""
    package = path.relative_to(root).parts[:-1]
    for node in ast.walk(ast.parse(path.read_text("utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = (*above, node.module) if node.module else above
            yield from (".".join((*module, alias.name)) for alias in node.names)


def breaches(rule: Rule, root: Path) -> list[str]:
    """Every import that the rule forbids, as "file: module"."""
    files = [path for path in sorted((root / rule.folder).rglob("*.py")) if _name(path, root) not in rule.excepted]
    return [
        f"{_name(path, root)}: {module}"
        for path in files
        for module in imported(path, root)
        if any(f"{module}.".startswith(f"{forbidden}.") for forbidden in rule.forbidden)
    ]


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.folder)
def test_imports_point_one_way(rule: Rule) -> None:
    if not (ROOT / rule.folder).is_dir():
        pytest.skip(f"{rule.folder} does not exist yet")
    assert breaches(rule, ROOT) == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("calib/a.py", "import omnid.graph"),
        ("calib/a.py", "from drivers import frame"),
        ("calib/a.py", "def f():\n    import time as clock"),
        ("calib/deep/a.py", "from socket import *"),
        ("drivers/a.py", "try:\n    from calib.rig import Rig\nexcept ImportError:\n    pass"),
        ("drivers/a.py", "from .. import calib"),
        ("omnid/a.py", "from threading import Lock"),
        ("omnid/stages/graph.py", "import os, threading"),
        ("omnid/stages/a.py", "import time"),
        ("omnid/core/a.py", "from omnid import engine"),
        ("omnid/core/a.py", "from ..stages.synchronise import Synchronise"),
        ("omnid/core/a.py", "from .. import cli"),
        ("omnid/core/a.py", "import logging.handlers"),
    ],
)
def test_a_breach_is_found(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_text(text, "utf-8")
    assert any(breaches(rule, tmp_path) for rule in RULES)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("calib/a.py", "from . import se3\nimport timeit, numpy as np"),
        ("drivers/a.py", "import threading, time\nimport omnidirectional, calibration"),
        ("omnid/engine/graph.py", "import threading"),
        ("omnid/core/a.py", "from .tracks import Tracks\nfrom omnid.messages import Odometry\nfrom calib import se3"),
        ("omnid/a.py", "import time\nfrom drivers.frame import Frame"),
    ],
)
def test_what_is_allowed_is_let_through(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_text(text, "utf-8")
    assert not any(breaches(rule, tmp_path) for rule in RULES)
