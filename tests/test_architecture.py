"""The rooms of the code base and the arrows between them: imports point one way, and the table below is exact.

A room is a package folder; a module that lies directly in `calib`, `drivers` or `omnid` is a room of its own. A room
that is missing from the table fails, and so does a row whose folder is gone, an import that the table does not allow,
and an allowed arrow that no import uses.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("calib", "drivers", "omnid")

# Room -> the rooms that it imports.
ARROWS: Mapping[str, str] = {
    "calib": "",
    "calib.boards": "calib.errors calib.models calib.se3",
    "calib.bounded_toml": "",
    "calib.bounded_yaml": "",
    "calib.camera_file": "calib.camera_table calib.models calib.validation",
    "calib.camera_table": "calib.errors calib.models calib.validation",
    "calib.covariance_table": "calib.camera_table calib.errors calib.models calib.rig_covariance calib.validation",
    "calib.errors": "",
    "calib.fit": "calib.boards calib.errors calib.models calib.rig calib.rig_covariance calib.se3",
    "calib.kalibr": "calib.bounded_yaml calib.errors calib.models calib.rig calib.rig_frame calib.se3 calib.validation",
    "calib.masks": "calib.errors calib.models",
    "calib.models": "calib.errors",
    "calib.ocam_file": "calib.errors calib.models calib.rig calib.rig_frame calib.validation",
    "calib.panorama": "calib.errors calib.models calib.rig calib.se3",
    "calib.rig": "calib.errors calib.models calib.rig_covariance calib.se3",
    "calib.rig_covariance": "calib.errors calib.models",
    "calib.rig_file":
        "calib.camera_table calib.covariance_table calib.errors calib.models calib.rig calib.se3 calib.validation",
    "calib.rig_frame": "calib.errors calib.models calib.rig calib.se3",
    "calib.se3": "",
    "calib.transform_file":
        "calib.bounded_yaml calib.errors calib.kalibr calib.models calib.rig calib.se3 calib.validation",
    "calib.validation": "calib.bounded_toml calib.errors calib.models calib.se3",
    "drivers": "",
    "drivers.cameras": "drivers.errors drivers.events drivers.frame drivers.logs drivers.motion",
    "drivers.errors": "",
    "drivers.events": "",
    "drivers.frame": "drivers.errors",
    "drivers.imu": "drivers.errors drivers.motion drivers.pseudo_terminal",
    "drivers.logs": "drivers.errors drivers.events drivers.frame drivers.motion",
    "drivers.motion": "",
    "drivers.motor": "",
    "drivers.motors": "drivers.errors drivers.motor drivers.motors.protocols drivers.pseudo_terminal",
    "drivers.motors.protocols": "drivers.errors drivers.motor",
    "drivers.motors.simulated": "drivers.errors drivers.motor drivers.motors.protocols",
    "drivers.pseudo_terminal": "drivers.errors",
    "omnid": "omnid.api omnid.config omnid.errors omnid.messages omnid.runs omnid.tracking_state omnid.version",
    "omnid.__main__": "omnid.cli",
    "omnid.api":
        "calib.errors calib.models calib.rig calib.rig_file drivers.errors drivers.frame omnid.config "
        "omnid.config_use omnid.engine omnid.errors omnid.messages omnid.runs omnid.settings omnid.settings_dump "
        "omnid.stages",
    "omnid.batch": "drivers.logs omnid.errors omnid.report omnid.version",
    "omnid.calibration":
        "calib.boards calib.errors calib.fit calib.masks calib.models calib.panorama calib.rig "
        "calib.rig_covariance calib.se3 drivers.errors drivers.frame drivers.logs omnid.config omnid.core.rig "
        "omnid.core.stereo omnid.errors omnid.messages omnid.report omnid.stages omnid.tracking_state omnid.transport",
    "omnid.cli": "calib.errors drivers.errors omnid.commands omnid.engine omnid.errors omnid.version",
    "omnid.client": "omnid.errors omnid.transport",
    "omnid.commands":
        "calib.boards calib.camera_file calib.fit calib.kalibr calib.masks calib.models calib.ocam_file calib.rig "
        "calib.rig_file calib.rig_frame calib.se3 calib.transform_file drivers.cameras drivers.errors drivers.frame "
        "drivers.logs omnid.batch omnid.calibration omnid.config omnid.config_use omnid.controller "
        "omnid.core.navigation omnid.core.odometry omnid.core.places omnid.core.rig omnid.diagnostics omnid.doctor "
        "omnid.engine omnid.errors omnid.formats omnid.messages omnid.monitor omnid.navigation_state "
        "omnid.recordings omnid.report omnid.runs omnid.service omnid.settings omnid.settings_dump omnid.simulation "
        "omnid.sinks omnid.stages omnid.transport omnid.viewer omnid.web",
    "omnid.config":
        "drivers.cameras drivers.logs omnid.controller omnid.core.control omnid.core.navigation "
        "omnid.core.obstacles omnid.core.odometry omnid.core.places omnid.core.stereo omnid.engine omnid.settings "
        "omnid.settings_migration omnid.transport",
    "omnid.config_use": "omnid.config omnid.errors omnid.settings",
    "omnid.controller":
        "drivers.errors drivers.motion drivers.motor drivers.motors drivers.motors.protocols "
        "drivers.motors.simulated omnid.core.control omnid.engine omnid.errors omnid.settings",
    "omnid.core": "",
    "omnid.core.control": "omnid.errors omnid.settings omnid.tracking_state",
    "omnid.core.mapping": "omnid.errors",
    "omnid.core.navigation":
        "omnid.core.control omnid.core.obstacles omnid.core.places omnid.errors omnid.navigation_state "
        "omnid.settings omnid.tracking_state",
    "omnid.core.obstacles":
        "calib.panorama calib.se3 omnid.core.mapping omnid.core.odometry omnid.errors omnid.settings",
    "omnid.core.odometry":
        "calib.panorama calib.se3 drivers.motion omnid.core omnid.core.stereo omnid.settings omnid.tracking_state",
    "omnid.core.odometry.paper": "calib.se3 omnid.core.odometry omnid.core.stereo omnid.errors omnid.tracking_state",
    "omnid.core.places":
        "calib.panorama calib.se3 omnid.core omnid.core.mapping omnid.core.odometry omnid.core.stereo omnid.settings "
        "omnid.tracking_state",
    "omnid.core.rig": "calib.fit calib.panorama calib.rig calib.se3 omnid.core.odometry omnid.core.stereo",
    "omnid.core.stereo": "calib.panorama omnid.settings",
    "omnid.diagnostics":
        "calib.panorama drivers.cameras drivers.frame drivers.imu omnid.config omnid.controller omnid.core.control "
        "omnid.core.odometry omnid.core.rig omnid.engine omnid.messages omnid.stages omnid.tracking_state "
        "omnid.transport",
    "omnid.doctor":
        "calib.errors calib.rig_file drivers.cameras drivers.errors drivers.motor drivers.motors omnid.config "
        "omnid.controller omnid.engine omnid.errors omnid.transport",
    "omnid.engine": "omnid.core omnid.errors omnid.settings",
    "omnid.errors": "",
    "omnid.examples": "calib.panorama calib.rig_file calib.se3 omnid",
    "omnid.formats":
        "calib.errors calib.panorama calib.se3 calib.validation omnid.core.mapping omnid.core.navigation "
        "omnid.core.places omnid.errors",
    "omnid.light": "calib.panorama calib.rig drivers.cameras drivers.frame omnid.config omnid.messages omnid.transport",
    "omnid.messages":
        "drivers.motion omnid.core.control omnid.core.mapping omnid.core.obstacles omnid.core.odometry "
        "omnid.core.stereo omnid.engine omnid.navigation_state omnid.tracking_state",
    "omnid.monitor":
        "calib.bounded_toml drivers.logs omnid.client omnid.core.control omnid.engine omnid.errors omnid.formats "
        "omnid.navigation_state omnid.sinks omnid.transport",
    "omnid.navigation_state": "",
    "omnid.recordings":
        "calib.errors calib.se3 calib.validation drivers.errors drivers.logs omnid.errors omnid.formats "
        "omnid.tracking_state omnid.transport",
    "omnid.refinement":
        "calib.errors calib.fit calib.rig calib.rig_covariance calib.rig_file calib.se3 omnid.calibration "
        "omnid.config omnid.core.rig omnid.errors omnid.messages omnid.stages omnid.tracking_state omnid.transport",
    "omnid.report":
        "calib.bounded_toml calib.errors calib.models calib.panorama calib.rig calib.rig_file calib.se3 "
        "drivers.errors drivers.frame drivers.logs omnid.config omnid.core.mapping omnid.core.places omnid.errors "
        "omnid.formats omnid.recordings omnid.settings_dump omnid.stages omnid.tracking_state omnid.transport "
        "omnid.version",
    "omnid.runs":
        "calib.rig calib.rig_file calib.se3 drivers.cameras drivers.errors drivers.events drivers.frame drivers.imu "
        "drivers.logs drivers.motion drivers.motor omnid.calibration omnid.config omnid.controller "
        "omnid.core.control omnid.core.mapping omnid.core.navigation omnid.core.odometry omnid.core.places "
        "omnid.diagnostics omnid.engine omnid.errors omnid.formats omnid.light omnid.messages omnid.refinement "
        "omnid.settings_dump omnid.sinks omnid.stages omnid.tracking_state omnid.transport",
    "omnid.sample": "",
    "omnid.service": "calib.errors calib.rig_file omnid.config omnid.errors omnid.settings_dump",
    "omnid.settings": "calib.bounded_toml omnid.errors omnid.settings_file",
    "omnid.settings_dump": "omnid.settings",
    "omnid.settings_file": "calib.bounded_toml omnid.errors",
    "omnid.settings_migration": "omnid.settings omnid.settings_file",
    "omnid.simulation":
        "calib.errors calib.models calib.rig calib.se3 calib.validation drivers.cameras drivers.errors "
        "drivers.frame drivers.imu drivers.motion drivers.motor drivers.motors.protocols drivers.motors.simulated "
        "omnid.config omnid.controller omnid.core.control omnid.core.mapping omnid.core.navigation omnid.engine "
        "omnid.errors omnid.formats omnid.messages omnid.navigation_state omnid.runs omnid.simulation.rendering "
        "omnid.sinks omnid.stages omnid.tracking_state",
    "omnid.simulation.rendering": "calib.models calib.rig calib.se3 omnid.core",
    "omnid.simulation.worlds": "",
    "omnid.sinks":
        "calib.se3 drivers.errors drivers.frame drivers.logs drivers.motion drivers.motor omnid.config "
        "omnid.controller omnid.core.control omnid.core.mapping omnid.core.places omnid.diagnostics omnid.engine "
        "omnid.errors omnid.formats omnid.messages omnid.navigation_state omnid.stages omnid.tracking_state "
        "omnid.transport",
    "omnid.stages":
        "calib.masks calib.models calib.panorama calib.rig calib.se3 drivers.errors drivers.frame drivers.motion "
        "drivers.motor omnid.config omnid.core.control omnid.core.mapping omnid.core.navigation omnid.core.obstacles "
        "omnid.core.odometry omnid.core.odometry.paper omnid.core.places omnid.core.rig omnid.core.stereo "
        "omnid.errors omnid.messages omnid.tracking_state",
    "omnid.tracking_state": "",
    "omnid.transport":
        "calib.se3 drivers.errors drivers.frame drivers.logs drivers.motion omnid.core.control "
        "omnid.core.navigation omnid.core.obstacles omnid.errors omnid.settings omnid.tracking_state",
    "omnid.version": "",
    "omnid.viewer":
        "calib.se3 drivers.errors drivers.frame drivers.logs omnid.client omnid.config omnid.core.mapping "
        "omnid.core.odometry omnid.engine omnid.errors omnid.messages omnid.monitor omnid.recordings omnid.runs "
        "omnid.sinks omnid.stages omnid.tracking_state omnid.transport",
    "omnid.web":
        "calib.se3 drivers.errors drivers.logs omnid.client omnid.core.navigation omnid.engine omnid.errors "
        "omnid.monitor omnid.report omnid.tracking_state omnid.transport",
}


@dataclass(frozen=True, slots=True)
class Rule:
    """No file of a room, or of the rooms below it, imports any of the modules; some files are excepted."""

    room: str
    forbidden: tuple[str, ...]
    excepted: tuple[str, ...] = ()


RULES = (
    Rule("calib", ("threading", "_thread", "time", "socket", "logging")),
    Rule("drivers.motors", ("numpy", "cv2")),
    Rule("omnid", ("threading", "_thread"),
         excepted=("omnid/engine/graph.py", "omnid/engine/inbox.py", "omnid/engine/bounded_call.py",
                   "omnid/engine/one_at_a_time.py")),
    Rule("omnid", ("zenoh",),
         excepted=("omnid/transport/bus.py", "omnid/transport/publishers.py", "omnid/transport/session.py",
                   "omnid/transport/client_session.py", "omnid/client.py")),
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
    for node in ast.walk(ast.parse(path.read_text("utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = (*above, node.module) if node.module else above
            yield from (".".join((*module, alias.name)) for alias in node.names)


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


def test_the_table_names_every_arrow_and_no_other() -> None:
    table = {room: set(targets.split()) for room, targets in ARROWS.items()}
    assert table == measured_arrows(ROOT)


def test_rooms_do_not_import_each_other_in_circles() -> None:
    TopologicalSorter(measured_arrows(ROOT)).prepare()  # raises CycleError with the rooms of the circle


@pytest.mark.parametrize("layer", ["calib", "drivers"])
def test_lower_layers_know_nothing_of_the_others(layer: str) -> None:
    arrows = measured_arrows(ROOT)
    targets = {target for room, found in arrows.items() if room.split(".")[0] == layer for target in found}
    assert {target.split(".")[0] for target in targets} <= {layer}


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: f"{rule.room} without {rule.forbidden[0]}")
def test_rooms_keep_clear_of_modules_that_are_not_theirs(rule: Rule) -> None:
    assert python_files(ROOT, rule.room)
    assert all(path.exists() for path in python_files(ROOT, rule.room))
    assert all((ROOT / path).exists() for path in rule.excepted)
    assert breaches(rule, ROOT) == []


def test_tests_mirror_the_rooms() -> None:
    """A test folder below tests/calib, tests/drivers or tests/omnid has the name of a room."""
    folders = {path.parent for layer in LAYERS for path in (ROOT / "tests" / layer).rglob("test_*.py")}
    missing = [folder for folder in folders if not (ROOT / folder.relative_to(ROOT / "tests")).is_dir()]
    assert missing == []


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("calib/fit/a.py", "from drivers import frame", {"calib.fit": {"drivers.frame"}}),
        ("calib/a.py", "def f():\n    import omnid.engine.graph as g", {"calib.a": {"omnid.engine"}}),
        ("omnid/engine/a.py", "from ..core import stereo", {"omnid.engine": {"omnid.core.stereo"}}),
        ("omnid/engine/a.py", "from omnid.engine.graph import Graph\nimport numpy", {"omnid.engine": set()}),
        ("omnid/a.py", "from omnid.core.stereo.sad import X", {"omnid.a": {"omnid.core.stereo"}}),
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
