"""filterpy's Kalman filter, loaded without the rest of filterpy.

`import filterpy.kalman` loads all of filterpy, and with it scipy.stats for the probability density of a measurement,
which no filter here asks for: half a second of processor time and 40 MB. The class is read from its own file, whose
imports of filterpy are answered from here. Nothing enters sys.modules: another part of a program that imports filterpy
gets all of it.
"""

from __future__ import annotations

import builtins
from functools import cache
from importlib.machinery import SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, ModuleType, SimpleNamespace
from typing import Any, Final

# What kalman_filter.py imports of filterpy -> the file that has it. The density of a measurement has none.
_FILES: Final = {"filterpy.common": "common/helpers.py"}
_DENSITIES: Final = "filterpy.stats"


def kalman_filter(dim_x: int, dim_z: int) -> Any:
    """Return a new filterpy.kalman.KalmanFilter of a state (dim_x, 1) and measurements (dim_z, 1)."""
    return _kalman_filter_class()(dim_x=dim_x, dim_z=dim_z)


@cache
def _kalman_filter_class() -> Any:
    spec = find_spec("filterpy")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("No module named 'filterpy'", name="filterpy")
    folder = Path(spec.origin).parent

    def import_of(name: str, *args: Any) -> Any:
        """Import as the statement does, but of filterpy only the files above."""
        if name == _DENSITIES:
            return SimpleNamespace(logpdf=_no_density)
        return _run(folder / _FILES[name], __import__) if name in _FILES else __import__(name, *args)

    return _run(folder / "kalman" / "kalman_filter.py", import_of).KalmanFilter


def _run(path: Path, import_function: Any) -> ModuleType:
    """Return the module of a file, whose import statements call a function."""
    module = ModuleType(f"omnid.core.kalman_filter.{path.stem}")
    module.__dict__["__builtins__"] = {**vars(builtins), "__import__": import_function}
    code = SourceFileLoader(module.__name__, str(path)).get_code(module.__name__)
    assert isinstance(code, CodeType)
    exec(code, module.__dict__)
    return module


def _no_density(*_: Any, **__: Any) -> float:
    raise NotImplementedError("the density of a measurement: import filterpy.kalman for it")
