"""The transform between two cameras, from a file or from a measured baseline."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib import se3
from calib.bounded_yaml import MAX_BYTES
from calib.errors import CalibError
from calib.kalibr import load_yaml
from calib.models.camera import Array
from calib.rig import MIN_BASELINE_M
from calib.validation import ValidatedTable, decode, read_bytes, toml_table

KEY = "T_lower_upper"
INVERSE_KEY = "T_upper_lower"


def read_transform(path: Path) -> Array:
    """Read T_lower_upper (4, 4): TOML or YAML with that key (or T_upper_lower), or a text of its 16 numbers."""
    text = decode(read_bytes(path, MAX_BYTES), str(path))
    if path.suffix == ".toml":
        return _named(toml_table(text, str(path)))
    if path.suffix in (".yaml", ".yml"):
        return _named(ValidatedTable(load_yaml(text, str(path)), str(path)))
    words = " ".join(line.partition("#")[0] for line in text.splitlines()).replace(",", " ").split()
    try:
        numbers: list[object] = [float(word) for word in words]
    except ValueError as error:
        raise CalibError(f"{path}: expected 16 numbers, the rows of {KEY}: {error}") from error
    rows = [numbers[start : start + 4] for start in range(0, len(numbers), 4)]
    return ValidatedTable({KEY: rows}, str(path)).transform(KEY)


def straight_up(baseline_m: float) -> Array:
    """Return T_lower_upper of an upper camera straight above the lower one, equally oriented, both looking up.

    A lens that looks up, and a camera that looks up into its mirror, both have their z axis pointing down.
    """
    if not (np.isfinite(baseline_m) and baseline_m >= MIN_BASELINE_M):
        raise CalibError(f"--baseline: expected metres, {MIN_BASELINE_M} or more, found {baseline_m}")
    return se3.transform(np.eye(3), (0.0, 0.0, -baseline_m))


def _named(table: ValidatedTable) -> Array:
    table.allow_only((KEY, INVERSE_KEY))
    if table.has(KEY) == table.has(INVERSE_KEY):
        raise CalibError(f"{table.file}: expected either {KEY} or {INVERSE_KEY}")
    return table.transform(KEY) if table.has(KEY) else se3.inverse(table.transform(INVERSE_KEY))
