"""Tickers act at their rate beside the stages, skip what they have missed, and end with the run."""

from __future__ import annotations

import threading
import time
from itertools import count

import pytest

from omnid.engine.graph import NEWEST, Graph
from omnid.engine.ticker import Ticker
from tests.omnid.engine.graph_parts import LONG_S, Action, Apply, Collect, both

pytestmark = pytest.mark.usefixtures("no_thread_is_left")


@both
def test_a_ticker_runs_beside_a_slow_stage(threaded: bool) -> None:
    graph, sink, action = Graph(threaded=threaded), Collect(), Action(enough=20)

    def hold(message: int) -> int:
        assert action.reached.wait(LONG_S)  # the stage ends after 20 more ticks only
        return message

    graph.sink("sink", sink, graph.stage("hold", Apply(hold), graph.source("one", lambda: [7])))
    ticker = graph.ticker("motor", 1e-3, action)
    graph.run()
    assert sink.got == [7]
    assert action.closed == 1
    assert ticker.stats.processed == action.calls >= 20
    assert ticker.stats in graph.telemetry.stages


@both
def test_a_failing_ticker_is_closed_and_ends_the_run(threaded: bool) -> None:
    graph, sink, action = Graph(threaded=threaded), Collect(), Action(enough=99, bad=3)
    graph.sink("sink", sink, graph.source("numbers", lambda: (number % 7 for number in count())), policy=NEWEST)
    graph.ticker("motor", 1e-3, action)
    with pytest.raises(OSError, match="no answer") as caught:
        graph.run()
    assert caught.value.__notes__ == ["in 'motor'"]
    assert (action.calls, action.closed, sink.finished) == (3, 1, 1)


def test_a_stalled_ticker_counts_missed_deadlines_without_a_burst() -> None:
    stalled, period_s = threading.Event(), 2e-3

    def action() -> None:
        if not stalled.is_set():
            threading.Event().wait(25 * period_s)
            stalled.set()
        elif ticker.stats.processed >= 5:
            ticker.halt()

    ticker, start_s = Ticker("motor", period_s, action), time.monotonic()
    ticker.run(lambda: False)
    assert ticker.stats.processed == 6
    assert ticker.stats.dropped >= 23  # of the deadlines within the stall the newest is served
    assert ticker.stats.processed + ticker.stats.dropped <= (time.monotonic() - start_s) / period_s + 1
