"""One measurement of the sensitivity table, in a process of its own (see sensitivity.py).

`python -m tests.benchmark.scaled_constant KIND FACTOR FILE NAME FOLDER ...` runs the logs with the constant NAME of
the source FILE times FACTOR and prints the outcome as JSON. The value is changed in the syntax tree while the module
is loaded, so that constants that are computed from it, and modules that import it, get the changed value. This module
imports the standard library only: nothing of the program may be loaded before the constant is changed.
"""

from __future__ import annotations

import ast
import contextlib
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, Final

SCALE: Final = "__scaled__"
TURNED_DEG: Final = (0.0, 0.1, 0.4, 3.0)  # right, within the limits, drifted, broken
PLACES_WRONG_DEG: Final = 0.1  # of the rig, so that odometry drifts and loops have something to correct


class ScaledLoader(SourceFileLoader):
    """Load a module with one constant scaled."""

    def __init__(self, fullname: str, path: str, name: str, factor: float) -> None:
        super().__init__(fullname, path)
        self._name, self._factor = name, factor
        self.values: list[Any] = []  # as written, and as used

    def get_code(self, fullname: str) -> Any:
        """Return the changed code; no compiled file is read or written."""
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        if not scale_in(tree, self._name):
            raise SystemExit(f"{path}: no constant {self._name}")
        return compile(ast.fix_missing_locations(tree), path, "exec")

    def exec_module(self, module: ModuleType) -> None:
        """Run the module with the function that scales in its names."""
        module.__dict__[SCALE] = self._scaled
        super().exec_module(module)

    def _scaled(self, value: Any, highest: float = math.inf) -> Any:
        new = scaled(value, self._factor)
        if math.isfinite(highest):
            new = min(new, highest)
        self.values = [value, new]
        return new


class Finder(MetaPathFinder):
    """Find the one module that is changed."""

    def __init__(self, path: Path, name: str, factor: float) -> None:
        self._module = ".".join(path.with_suffix("").parts)
        self.loader: ScaledLoader | None = None
        self._name, self._factor = name, factor

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the module's usual specification with the other loader."""
        if fullname != self._module:
            return None
        spec = PathFinder.find_spec(fullname, path)
        assert spec is not None and spec.origin is not None
        self.loader = spec.loader = ScaledLoader(fullname, spec.origin, self._name, self._factor)
        return spec


def scale_in(tree: ast.Module, name: str) -> bool:
    """Wrap the value of a module-level constant, or the default of a knob, in a call of SCALE; False if not found."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            for k, one in enumerate(target.elts):
                if isinstance(one, ast.Name) and one.id == name:
                    node.value.elts[k] = _call(node.value.elts[k])
                    return True
        elif isinstance(target, ast.Name) and target.id == name:
            value = node.value
            if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == "knob":
                highest = [word.value for word in value.keywords if word.arg == "high"]
                value.args[0] = _call(value.args[0], *highest)
            else:
                node.value = _call(value)
            return True
    return False


def _call(value: ast.expr, *limits: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(SCALE, ast.Load()), [value, *limits], [])


def scaled(value: Any, factor: float) -> Any:
    """Return a number, or each of a tuple, times the factor; an integer stays one, and above 0."""
    if isinstance(value, tuple):
        return tuple(scaled(part, factor) for part in value)
    if isinstance(value, int):
        return max(1, round(value * factor))
    # A number of numpy keeps its type, as compiled functions expect it.
    return type(value)(value * factor)


def accuracy(folder: Path) -> dict[str, float]:
    """Return errors and states of odometry on a log."""
    import omnid
    from omnid.formats.tum import Trajectory, read_tum
    from omnid.recordings.evaluation import evaluate
    from tests.benchmark.accuracy import rig_of

    result = omnid.replay(folder / "log.mcap", rig_of(folder), overrides=["places.enabled=false"])
    found = evaluate(Trajectory(result.stamps_ns, result.T_odom_rig), read_tum(folder / "truth.txt"))
    tracking = sum(state.value == "tracking" for state in result.states) / len(result.states)
    return {"ate_mm": 1e3 * found.ate_rmse_m, "not_tracking": 1 - tracking}


def places(folder: Path) -> dict[str, float]:
    """Return the errors of the pose in the map and the loops on a closed drive, with a rig that is a little wrong."""
    from omnid.core.places.place_map import PlaceMap
    from omnid.formats.tum import Trajectory, read_tum
    from omnid.recordings.evaluation import evaluate
    from tests.benchmark.accuracy import rig_of
    from tests.benchmark.places import FALSE_M, FALSE_RAD, loop_errors, replayed

    result, truth = replayed(folder, PLACES_WRONG_DEG, 1), read_tum(folder / "truth.txt")
    errors = loop_errors(result.places or PlaceMap(), truth, rig_of(folder))
    return {
        "ate_mm": 1e3 * evaluate(Trajectory(result.stamps_ns, result.T_map_rig), truth).ate_rmse_m,
        "loops": len(errors),
        "false": sum(m > FALSE_M or rad > FALSE_RAD for m, rad in errors),
    }


def rig(folder: Path) -> dict[str, str]:
    """Return what a replay says of the right rig, and of one whose upper camera is turned about the x axis."""
    import omnid
    from omnid.errors import OmnidError
    from tests.benchmark.accuracy import rig_of
    from tests.simulation.rigs import with_upper_rotated

    outcomes = {}
    for turned_deg in TURNED_DEG:
        turned = with_upper_rotated(rig_of(folder), (turned_deg, 0.0, 0.0)) if turned_deg else rig_of(folder)
        try:
            result = omnid.replay(folder / "log.mcap", turned, overrides=["places.enabled=false"])
            outcome = "warned" if any("rig" in line for line in result.warnings) else "accepted"
        except OmnidError:
            outcome = "refused"
        outcomes[f"{turned_deg:g} deg"] = outcome
    return outcomes


def obstacles(folder: Path) -> dict[str, list[float]]:
    """Return what the obstacle grid says of the kept images of a folder.

    Counts of directions: all with something within 4 m, those of them that are missed, and that have something false
    before it; those of the things themselves, and missed; those that are open, and said to be, to 1, 1.5, 2 and 3 m.
    """
    import numpy as np

    from tests.experiments.obstacle_posterior.drives import Scores, judge, kept_images, usual_robot
    from tests.experiments.obstacle_posterior.scenes import obstacle_scene

    scores, (size_px, seed) = Scores(), map(int, re.findall(r"\d+", folder.name))
    for file in sorted(folder.glob("*.npz")):
        judge(obstacle_scene(file.stem, seed), usual_robot(size_px), kept_images(file), scores)
    missed, of_target = np.sum(scores.target_missed, axis=0).tolist()
    free, is_open = scores.open.T.tolist()
    return {
        "all": [scores.directions, scores.missed, scores.false],
        "things": [of_target, missed],
        "open": is_open,
        "free": free,
    }


KINDS: Final = {"odometry": accuracy, "places": places, "rig": rig, "obstacles": obstacles}


def outcomes(kind: str, folders: Sequence[str], file: str) -> Iterator[tuple[str, Any]]:
    """Yield the outcome of each log, with a constant of a file changed; an error of the program is one."""
    if kind == "obstacles" and not file.endswith("_kernels.py"):  # compiled with the changed value where they are
        from omnid.engine.kernel_cache import prepare_kernels

        prepare_kernels()
    for folder in folders:
        try:
            yield folder, KINDS[kind](Path(folder))
        except Exception as error:
            yield folder, {"error": f"{type(error).__name__}: {error}"[:200]}


def main(words: Sequence[str]) -> None:
    """Scale, run, print."""
    kind, factor, file, name, *folders = words
    finder = Finder(Path(file), name, float(factor))
    if not math.isclose(float(factor), 1.0):
        sys.meta_path.insert(0, finder)
    with contextlib.redirect_stdout(sys.stderr):
        found = dict(outcomes(kind, folders, file))
    values = finder.loader.values if finder.loader is not None else []
    print(json.dumps({"values": [str(value) for value in values], "found": found}))


if __name__ == "__main__":
    main(sys.argv[1:])
