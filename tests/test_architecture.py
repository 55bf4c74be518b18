"""Policy on imports: which packages may never import which others.

A module that lies directly in `calib`, `drivers` or `omnid` counts as a package of its own. Packages form tiers, and
imports point to the same or a lower tier, without circles. Rules name what single packages must not import at all. A
package that no tier names fails, and so does a tier or a rule that names a package that does not exist.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("calib", "drivers", "omnid")

# From the lowest tier to the highest: a package imports those of its own tier and of lower ones, never of a higher one.
# A name covers the package and the packages below it, unless one of these has a place of its own.
TIERS: Mapping[str, str] = {
    "geometry": "calib",
    "hardware and logs": "drivers",
    "settings and states": "omnid.errors omnid.version omnid.tracking_state "
    "omnid.settings omnid.sample omnid.plain_text",
    "numerics": "omnid.core",
    "threads, queues, the controller process": "omnid.engine omnid.controller",
    "messages, formats, bus": "omnid.messages omnid.config omnid.formats omnid.transport",
    "parts of a run": "omnid.stages omnid.recordings omnid.service",
    "what watches and writes a run": "omnid.diagnostics omnid.sinks omnid.light omnid.report omnid.calibration",
    "runs and clients": "omnid.runs omnid.simulation omnid.client omnid.monitor omnid.doctor",
    "interfaces": "omnid omnid.api omnid.web omnid.viewer omnid.examples omnid.commands omnid.cli omnid.__main__",
}


@dataclass(frozen=True, slots=True)
class Rule:
    """No file of a package, or of the packages below it, imports any of the modules; some files are excepted."""

    package: str
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
    Rule("omnid", ("threading", "_thread"), excepted=("omnid/engine/graph.py",)),
    Rule(
        "omnid",
        ("zenoh",),
        excepted=(
            "omnid/transport/bus.py",
            "omnid/transport/ros2.py",
            "omnid/transport/session.py",
            "omnid/client.py",
        ),
    ),
    Rule("omnid.core", ("threading", "time", "logging", "socket", "subprocess")),
    Rule("omnid.core.control", ("numpy", "cv2")),
    Rule("omnid.controller", ("cv2",)),
    Rule("omnid.stages", ("threading", "time")),
)


@dataclass(frozen=True, slots=True)
class Import:
    """An import of a file of the product."""

    file: str  # relative to the root
    name: str  # full name of what is imported

    @property
    def package(self) -> str:
        """The package of the file, such as "omnid.core.stereo", or "omnid.settings" for omnid/settings.py."""
        parts = Path(self.file).with_suffix("").parts
        return ".".join(parts if len(parts) == 2 and parts[1] != "__init__" else parts[:-1])


@cache
def imports() -> tuple[Import, ...]:
    """Return all imports of the product, at the top of files or within functions."""
    found = []
    for path in sorted(path for layer in LAYERS for path in (ROOT / layer).rglob("*.py")):
        package = path.relative_to(ROOT).parts[:-1]
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                above = package[: len(package) - node.level + 1] if node.level else ()
                base = [*above, *filter(None, [node.module])]
                names = [".".join([*base, alias.name]) for alias in node.names]
            else:
                continue
            found += [Import(path.relative_to(ROOT).as_posix(), name) for name in names]
    return tuple(found)


@cache
def package_of_module(module: str) -> str | None:
    """Return the package that an imported name lies in; None for what is not ours."""
    parts = module.split(".")
    if parts[0] not in LAYERS:
        return None
    while len(parts) > 1 and not (path := ROOT.joinpath(*parts)).is_dir():
        if path.with_suffix(".py").exists():
            return Import(path.with_suffix(".py").relative_to(ROOT).as_posix(), "").package
        parts.pop()
    return ".".join(parts)


def measured_arrows() -> dict[str, set[str]]:
    """Return for each package the other packages that its files import."""
    files = [path.relative_to(ROOT).as_posix() for layer in LAYERS for path in (ROOT / layer).rglob("*.py")]
    arrows: dict[str, set[str]] = {Import(file, "").package: set() for file in files}
    for each in imports():
        target = package_of_module(each.name)
        if target not in (None, each.package):
            arrows[each.package].add(str(target))
    return arrows


def breaches(rule: Rule) -> list[str]:
    """Return every import that the rule forbids, as "file: module"."""
    return [
        f"{each.file}: {each.name}"
        for each in imports()
        if f"{each.package}.".startswith(f"{rule.package}.") and each.file not in rule.excepted
        if any(f"{each.name}.".startswith(f"{forbidden}.") for forbidden in rule.forbidden)
    ]


def tier_of(package: str) -> int | None:
    """Return the tier that names the package or the nearest package above it; None where no tier does.

    `omnid` itself covers its own file only, so that a new package has to be placed.
    """
    named = {name: tier for tier, names in enumerate(TIERS.values()) for name in names.split()}
    parts = package.split(".")
    above = [".".join(parts[:length]) for length in range(len(parts), 0, -1)]
    return next((named[name] for name in above if name in named and (name == package or name != "omnid")), None)


def test_every_package_has_a_tier_and_every_tier_names_packages_that_exist() -> None:
    packages = set(measured_arrows())
    named = [name for names in TIERS.values() for name in names.split()]
    assert [package for package in sorted(packages) if tier_of(package) is None] == []
    assert sorted(set(named)) == sorted(named)
    assert [name for name in named if not any(f"{package}.".startswith(f"{name}.") for package in packages)] == []


def test_imports_point_to_the_same_or_a_lower_tier() -> None:
    upward = [
        f"{package} -> {target}"
        for package, targets in measured_arrows().items()
        for target in sorted(targets)
        if (tier_of(package) or 0) < (tier_of(target) or 0)
    ]
    assert upward == []


def test_packages_do_not_import_each_other_in_circles() -> None:
    TopologicalSorter(measured_arrows()).prepare()  # raises CycleError with the packages of the circle


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: f"{rule.package} without {rule.forbidden[0]}")
def test_packages_import_no_module_that_is_barred_to_them(rule: Rule) -> None:
    assert ROOT.joinpath(*rule.package.split(".")).is_dir()
    assert all((ROOT / path).exists() for path in rule.excepted)
    assert breaches(rule) == []
