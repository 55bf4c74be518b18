"""Signals reach their handler within a context only; programs find omnid's modules, and none of the current folder."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import pytest

from omnid.engine.process import STOP_SIGNALS, handle_stop_signals, python, python_environment

ROOT = Path(__file__).parents[3]


@pytest.mark.usefixtures("default_signals")
def test_each_signal_reaches_the_handler_and_the_one_before_comes_back() -> None:
    before, came = {number: signal.getsignal(number) for number in STOP_SIGNALS}, list[int]()
    with pytest.raises(ValueError), handle_stop_signals(lambda number, _: came.append(number)):
        for number in STOP_SIGNALS:
            signal.raise_signal(number)
        raise ValueError
    assert came == [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    assert {number: signal.getsignal(number) for number in STOP_SIGNALS} == before


def test_modules_of_the_current_folder_are_not_imported(tmp_path: Path) -> None:
    (tmp_path / "omnid.py").write_text("print('planted')")
    words = python("-c", "import omnid, os; print(omnid.__file__, os.environ['KEY'])")
    environment = python_environment(KEY="a")
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"{ROOT / 'omnid' / '__init__.py'} a\n"
