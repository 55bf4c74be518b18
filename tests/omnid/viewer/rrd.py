"""Reading of .rrd files with rerun's own reader."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

WITHOUT = "needs rerun: pip install 'rerun-sdk>=0.41'"


class Row(NamedTuple):
    """A value of an entity and its stamp."""

    stamp_ns: int
    value: Any  # a list, one element per instance


def need_rerun() -> None:
    """Skip the calling test where rerun is not installed."""
    pytest.importorskip("rerun", reason=WITHOUT)


def rows(path: Path, entity: str, component: str) -> list[Row]:
    """Return all values of a component in the order of their stamps, without static ones."""
    from rerun.chunk import RrdReader

    found = []
    for chunk in RrdReader(str(path)).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            table = chunk.to_record_batch()
            if component in table.schema.names:
                stamps_ns = table.column("stamp").cast("int64").to_pylist()
                found += map(Row, stamps_ns, table.column(component).to_pylist())
    return sorted(found, key=lambda row: row.stamp_ns)


def entities(path: Path) -> set[str]:
    """Return the paths of all entities."""
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(str(path)).stream()}


def positions(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps [ns] and positions (N, 3) [m] of the robot."""
    found = rows(path, "/odom/base_link", "Transform3D:translation")
    return np.array([row.stamp_ns for row in found]), np.array([row.value[0] for row in found])


def verified(path: Path) -> bool:
    """True if rerun's own program finds no fault in the file."""
    words = [sys.executable, "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())"]
    return subprocess.run([*words, "rrd", "verify", str(path)], capture_output=True, check=False).returncode == 0
