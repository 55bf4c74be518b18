"""The motor drivers load neither numpy nor OpenCV: the process that steers imports them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
MODULES = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "drivers/motors").rglob("*.py")]
HEAVY = {"numpy", "cv2", "mcap", "rosbags", "omnid", "calib"}
PROGRAM = """
import importlib, json, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def test_all_modules_load_no_heavy_package() -> None:
    assert len(MODULES) > 10
    command = [sys.executable, "-c", PROGRAM, "drivers.motor", *MODULES]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert HEAVY.isdisjoint(json.loads(done.stdout))
