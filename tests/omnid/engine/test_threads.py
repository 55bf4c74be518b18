"""Parts of the engine without a graph: threads, programs that are started, signals, counters."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from omnid.engine.process import STOP_SIGNALS, handle_stop_signals, python, python_environment
from omnid.engine.telemetry import Histogram, StageStats, Telemetry
from omnid.engine.threads import Poller, started

LONG_S = 20.0  # a timeout that only a defect reaches


def test_a_caller_goes_on_after_its_time_and_may_wait_later() -> None:
    called, release, done = threading.Event(), threading.Event(), list[bool]()
    assert started(called.set, "quick")(LONG_S) and called.is_set()
    has_ended = started(lambda: done.append(release.wait(LONG_S)), "test")
    assert not has_ended(0.01) and not done
    release.set()
    assert has_ended(None) and done == [True]


def test_a_call_that_blocks_for_ever_does_not_keep_the_program_from_ending() -> None:
    code = (
        "import threading; from omnid.engine.threads import started; "
        "print(started(threading.Event().wait, 'blocked')(0.01))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "False\n"


@pytest.mark.usefixtures("no_thread_is_left")
def test_the_calls_of_a_poller_go_on_after_an_error_and_end_with_close(capsys: pytest.CaptureFixture[str]) -> None:
    calls, made, enough = list[str](), threading.Event(), threading.Event()

    def action() -> None:
        assert made.wait(LONG_S)  # the first calls may come before the poller has its name here
        calls.append(threading.current_thread().name)
        if len(calls) == 1:
            raise OSError("no link")
        if len(calls) == 3:
            enough.set()
            poller.close()  # an action may close its own poller

    poller = Poller(action, 1e-3, "short work")
    made.set()
    assert enough.wait(LONG_S)
    poller.close()
    assert set(calls) == {"short work"} and capsys.readouterr().err.count("OSError: no link") == 1
    assert not threading.Event().wait(0.02) and len(calls) == 3


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


@pytest.mark.parametrize("centre", [-10.0, -5.0, 4.0])
def test_quantiles_agree_with_sorting(centre: float) -> None:
    durations_s = np.random.default_rng(1).lognormal(centre, 0.7, 5000)
    histogram = Histogram()
    for duration_s in durations_s.tolist():
        histogram.add(duration_s)
    expected = np.quantile(durations_s, [0.0, 0.01, 0.5, 0.9, 0.99], method="inverted_cdf")
    assert histogram.quantiles(0.0, 0.01, 0.5, 0.9, 0.99) == pytest.approx(expected, rel=0.05)
    assert histogram.p(1.0) == histogram.max_s == durations_s.max()
    assert histogram.count == 5000


def test_summary_has_a_row_per_stage_in_milliseconds() -> None:
    telemetry = Telemetry()
    stats = telemetry.add(StageStats("stereo", processed=2, dropped=1))
    telemetry.add(StageStats("idle"))
    stats.wall.add(0.010)
    stats.wall.add(0.030)
    stereo, idle = telemetry.summary()
    assert stereo[:3] == ("stereo", 2, 1) and stereo[3:] == pytest.approx((10.0, 30.0, 30.0), rel=0.05)
    assert idle[:3] == ("idle", 0, 0) and all(map(math.isnan, idle[3:]))
