"""The notebook of the examples runs: in Jupyter where that is installed, else its cells one after the other."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[2] / "omnid" / "examples" / "first_replay.ipynb"
CELL_S = 300  # generous: a replay of 99 pairs on a busy machine
HAS_JUPYTER = all(find_spec(name) for name in ("nbclient", "nbformat", "ipykernel"))


def test_it_is_small_and_kept_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    assert NOTEBOOK.stat().st_size < 10_000
    assert not any(cell.get("outputs") for cell in cells)


@pytest.mark.skipif(HAS_JUPYTER, reason="it runs in Jupyter")
def test_its_cells_run(monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    names["plt"].close("all")
    assert names["errors"].ate_rmse_m < 0.01  # of 4.8 m; `omnid demo` prints 1 mm
    assert names["errors"].pairs == 99


@pytest.mark.skipif(not HAS_JUPYTER, reason="needs nbclient and ipykernel: pip install '.[docs]'")
def test_it_runs_in_jupyter() -> None:
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    NotebookClient(notebook, timeout=CELL_S).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("ATE" in output.get("text", "") for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
