"""Policy on imports: which rooms may never import which others.

A room is a package folder; a module that lies directly in `calib`, `drivers` or `omnid` is a room of its own. Rooms
form tiers, and imports point to the same or a lower tier, without circles. Rules name what single rooms must not
import at all. A room that no tier names fails, and so does a tier or a rule that names a room that does not exist.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("calib", "drivers", "omnid")

# From the lowest tier to the highest: a room imports rooms of its own tier and of lower ones, never of a higher one.
# A name covers the room and the rooms below it, unless one of these has a place of its own.
TIERS: Mapping[str, str] = {
    "geometry": "calib",
    "hardware and logs": "drivers",
    "settings and states": "omnid.errors omnid.version omnid.navigation_state omnid.tracking_state "
    "omnid.settings omnid.sample "
    "omnid.plain_text omnid.utc",
    "numerics": "omnid.core",
    "threads, queues, the controller process": "omnid.engine omnid.controller",
    "messages, formats, bus": "omnid.messages omnid.camera_config omnid.config omnid.formats omnid.transport",
    "parts of a run": "omnid.stages omnid.recordings omnid.service",
    "what watches and writes a run": "omnid.diagnostics omnid.sinks omnid.light omnid.report omnid.calibration",
    "runs and clients": "omnid.runs omnid.simulation omnid.client omnid.monitor omnid.doctor",
    "interfaces": "omnid omnid.api omnid.web omnid.viewer omnid.examples omnid.commands omnid.cli omnid.__main__",
}


@dataclass(frozen=True, slots=True)
class Rule:
    """No file of a room, or of the rooms below it, imports any of the modules; some files are excepted."""

    room: str
    forbidden: tuple[str, ...]
    excepted: tuple[str, ...] = ()


RULES = (
    Rule("calib", ("drivers", "omnid")),
    Rule("drivers", ("calib", "omnid")),
    Rule("omnid.core", ("drivers.cameras", "drivers.logs", "drivers.motors")),
    Rule("omnid.core.control", ("calib.se3", "calib.se2_arrays", "calib.models", "calib.panorama", "calib.rig")),
    Rule("omnid.core.control", ("omnid.core.odometry", "omnid.core.places", "omnid.core.navigation")),
    Rule("omnid.core.odometry", ("omnid.core.places", "omnid.core.obstacles", "omnid.core.navigation")),
    Rule("omnid.controller", ("omnid.stages", "omnid.core.odometry", "omnid.core.navigation", "omnid.transport")),
    Rule("omnid.web", ("omnid.stages", "omnid.runs", "omnid.controller", "drivers.cameras", "drivers.motors")),
    Rule("calib", ("threading", "_thread", "time", "socket", "logging")),
    Rule("drivers.motors", ("numpy", "cv2")),
    Rule(
        "omnid",
        ("threading", "_thread"),
        excepted=(
            "omnid/engine/graph.py",
            "omnid/engine/threads.py",
        ),
    ),
    Rule(
        "omnid",
        ("zenoh",),
        excepted=(
            "omnid/transport/bus.py",
            "omnid/transport/intake.py",
            "omnid/transport/ros2.py",
            "omnid/transport/session.py",
            "omnid/transport/driver.py",
            "omnid/client.py",
        ),
    ),
    Rule("omnid.core", ("threading", "time", "logging", "socket", "subprocess")),
    Rule("omnid.core.control", ("numpy", "cv2")),
    Rule("omnid.controller", ("cv2",)),
    Rule("omnid.stages", ("threading", "time")),
)


def python_files(root: Path, room: str) -> list[Path]:
    """Return the files of a room and of the rooms below it, sorted."""
    path = root.joinpath(*room.split("."))
    return sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def room_of_file(path: Path, root: Path) -> str:
    """Return the room of a file, such as "omnid.core.stereo", or "omnid.settings" for omnid/settings.py."""
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts if len(parts) == 2 and parts[1] != "__init__" else parts[:-1])


@cache
def room_of_module(module: str, root: Path) -> str | None:
    """Return the room that an imported name lies in; None for what is not ours."""
    parts = module.split(".")
    if parts[0] not in LAYERS:
        return None
    while len(parts) > 1:
        path = root.joinpath(*parts)
        if path.is_dir():
            return ".".join(parts)
        if path.with_suffix(".py").exists():
            return room_of_file(path.with_suffix(".py"), root)
        parts.pop()
    return parts[0]


def imported_names(path: Path, root: Path) -> Iterator[str]:
    """Yield the full name of everything that a file imports, at its top or within functions."""
    package = path.relative_to(root).parts[:-1]
    for level, module, names in _import_statements(path.read_text("utf-8")):
        if module is None and not level:
            yield from names
            continue
        above = package[: len(package) - level + 1] if level else ()
        base = (*above, module) if module else above
        yield from (".".join((*base, name)) for name in names)


@cache
def _import_statements(text: str) -> tuple[tuple[int, str | None, tuple[str, ...]], ...]:
    """Return (level, module, names) of each import; plain `import a, b` has level 0 and no module.

    The result is kept by text: each test reads all files, and parsing them takes seconds.
    """
    found: list[tuple[int, str | None, tuple[str, ...]]] = []
    for node in _statements(ast.parse(text)):
        if isinstance(node, ast.Import):
            found.append((0, None, tuple(alias.name for alias in node.names)))
        elif isinstance(node, ast.ImportFrom):
            found.append((node.level, node.module, tuple(alias.name for alias in node.names)))
    return tuple(found)


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield all statements, handlers and cases of a file, without the expressions in them, which are most of it."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            below = getattr(node, part, ())
            waiting += below if isinstance(below, list) else ()


def measured_arrows(root: Path) -> dict[str, set[str]]:
    """Return for each room the other rooms that its files import."""
    arrows: dict[str, set[str]] = {}
    for layer in LAYERS:
        for path in python_files(root, layer):
            room = room_of_file(path, root)
            targets = {room_of_module(name, root) for name in imported_names(path, root)} - {None, room}
            arrows.setdefault(room, set()).update(target for target in targets if target)
    return arrows


def breaches(rule: Rule, root: Path) -> list[str]:
    """Return every import that the rule forbids, as "file: module"."""
    files = [path for path in python_files(root, rule.room) if path.relative_to(root).as_posix() not in rule.excepted]
    return [
        f"{path.relative_to(root).as_posix()}: {name}"
        for path in files
        for name in imported_names(path, root)
        if any(f"{name}.".startswith(f"{forbidden}.") for forbidden in rule.forbidden)
    ]


def tier_of(room: str) -> int | None:
    """Return the tier that names the room or the nearest room above it; None where no tier does.

    `omnid` itself covers the package's own file only, so that a new room has to be placed.
    """
    named = {name: tier for tier, names in enumerate(TIERS.values()) for name in names.split()}
    parts = room.split(".")
    for length in range(len(parts), 0, -1):
        name = ".".join(parts[:length])
        if name in named and (name == room or name != "omnid"):
            return named[name]
    return None


def test_every_room_has_a_tier_and_every_tier_names_rooms_that_exist() -> None:
    rooms = set(measured_arrows(ROOT))
    named = [name for names in TIERS.values() for name in names.split()]
    assert [room for room in sorted(rooms) if tier_of(room) is None] == []
    assert sorted(set(named)) == sorted(named)
    assert [name for name in named if not any(f"{room}.".startswith(f"{name}.") for room in rooms)] == []


def test_imports_point_to_the_same_or_a_lower_tier() -> None:
    upward = [
        f"{room} -> {target}"
        for room, targets in measured_arrows(ROOT).items()
        for target in sorted(targets)
        if (tier_of(room) or 0) < (tier_of(target) or 0)
    ]
    assert upward == []


def test_rooms_do_not_import_each_other_in_circles() -> None:
    TopologicalSorter(measured_arrows(ROOT)).prepare()  # raises CycleError with the rooms of the circle


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: f"{rule.room} without {rule.forbidden[0]}")
def test_rooms_keep_clear_of_modules_that_are_not_theirs(rule: Rule) -> None:
    assert python_files(ROOT, rule.room)
    assert all(path.exists() for path in python_files(ROOT, rule.room))
    assert all((ROOT / path).exists() for path in rule.excepted)
    assert breaches(rule, ROOT) == []


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("calib/fit/a.py", "from drivers import frame", {"calib.fit": {"drivers.frame"}}),
        ("calib/a.py", "def f():\n    import omnid.engine.graph as g", {"calib.a": {"omnid.engine"}}),
        ("omnid/engine/a.py", "from ..core import stereo", {"omnid.engine": {"omnid.core.stereo"}}),
        ("omnid/engine/a.py", "from omnid.engine.graph import Graph\nimport numpy", {"omnid.engine": set()}),
        ("omnid/a.py", "from omnid.core.stereo.semiglobal import X", {"omnid.a": {"omnid.core.stereo"}}),
    ],
)
def test_an_arrow_is_found(tmp_path: Path, name: str, text: str, found: dict[str, set[str]]) -> None:
    for folder in ("calib/fit", "drivers", "omnid/engine", "omnid/core/stereo"):
        (tmp_path / folder).mkdir(parents=True)
    for module in ("drivers/frame", "omnid/engine/graph", "omnid/core/stereo/sad"):
        (tmp_path / f"{module}.py").write_text("", "utf-8")
    (tmp_path / name).write_text(text, "utf-8")
    arrows = measured_arrows(tmp_path)
    assert {room: arrows[room] for room in found} == found


@pytest.mark.parametrize(
    ("name", "text", "broken"),
    [
        ("calib/a.py", "def f():\n    import time as clock", True),
        ("calib/deep/a.py", "from socket import *", True),
        ("omnid/stages/graph.py", "import os, threading", True),
        ("omnid/core/a.py", "import logging.handlers", True),
        ("calib/a.py", "import timeit, numpy as np", False),
        ("omnid/engine/graph.py", "import threading", False),
    ],
)
def test_a_forbidden_module_is_found(tmp_path: Path, name: str, text: str, broken: bool) -> None:
    for layer in LAYERS:
        (tmp_path / layer).mkdir()
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text, "utf-8")
    rules = [rule for rule in RULES if (tmp_path / rule.room.replace(".", "/")).is_dir()]
    assert any(breaches(rule, tmp_path) for rule in rules) == broken
