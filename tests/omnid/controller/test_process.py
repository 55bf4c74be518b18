"""The controller process is light: its module loads nothing of perception, so that it starts fast and stays small."""

from __future__ import annotations

import json
import subprocess
import sys

HEAVY = (
    "calib.models",
    "calib.panorama",
    "calib.rig",
    "calib.se3",
    "cv2",
    "numpy",
    "rosbags",
    "scipy",
    "zenoh",
    "drivers.cameras",
    "drivers.frame",
    "drivers.logs",
    "drivers.motors.simulated",
    "omnid.config",
    "omnid.core.mapping",
    "omnid.core.odometry",
    "omnid.core.places",
    "omnid.core.stereo",
    "omnid.engine.graph",
    "omnid.messages",
    "omnid.stages",
    "omnid.transport",
)


def loaded(statement: str) -> list[str]:
    """Return the names of the modules that a fresh interpreter has loaded after a statement."""
    script = f"import json, sys\n{statement}\nprint(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    names: list[str] = json.loads(done.stdout)
    return names


def test_loads_no_module_of_perception() -> None:
    modules = loaded("import omnid.controller.process")
    assert "omnid.controller.controller" in modules
    assert [name for name in modules if any(f"{name}.".startswith(f"{heavy}.") for heavy in HEAVY)] == []


def test_loads_few_modules_of_its_own() -> None:
    """Each import of the process is a decision: raise the number with care."""
    modules = loaded("import omnid.controller.process")
    assert len([name for name in modules if name.split(".")[0] in ("omnid", "drivers")]) <= 58
