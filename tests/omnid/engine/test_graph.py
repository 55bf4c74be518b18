"""The graph: end of the run, errors, stops; threads and inline give the same results."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from functools import partial
from itertools import count
from typing import NoReturn

import pytest

from omnid.engine.graph import LOSSLESS, NEWEST, Graph
from omnid.errors import OmnidError
from tests.omnid.engine.graph_parts import LONG_S, Apply, Collect, Sums, both, fail_at, stopped_at

pytestmark = pytest.mark.usefixtures("no_thread_is_left", "default_signals")


def summed(threaded: bool) -> tuple[list[int], list[int], list[int]]:
    graph, raw, sums, late = Graph(threaded=threaded), Collect(), Collect(), Collect()
    numbers = graph.source("numbers", lambda: range(101))
    graph.sink("raw", raw, numbers)
    pairs = graph.stage("pairs", Sums(), numbers)
    graph.sink("sums", sums, pairs)
    graph.sink("late", late, graph.stage("quads", Sums(), pairs))
    graph.run()
    assert [sink.finished for sink in (raw, sums, late)] == [1, 1, 1]
    return raw.got, sums.got, late.got


def test_threads_give_the_results_of_inline() -> None:
    raw, sums, late = summed(threaded=True)
    assert (raw, sums, late) == summed(threaded=False)
    assert raw == list(range(101))
    assert sums == [4 * k + 1 for k in range(50)] + [100, -1]  # with the results of finish
    assert late == [sums[k] + sums[k + 1] for k in range(0, 52, 2)] + [-1]


@both
def test_a_source_settles_until_all_that_follows_is_done(threaded: bool) -> None:
    graph, slow = Graph(policy=LOSSLESS, threaded=threaded, sinks_wait=True), Collect()
    behind: list[int] = []

    class Later:
        """A stage that goes on after its result was passed on."""

        done = 0

        def process(self, message: int) -> int:
            return message

        def after(self) -> None:
            threading.Event().wait(1e-3)
            self.done += 1

    later = Later()

    def numbers() -> Iterator[int]:
        for number in range(20):
            yield number
            graph.settle()
            behind.append(2 * number + 2 - later.done - len(slow.got))

    graph.sink("slow", slow, graph.stage("later", later, graph.source("numbers", numbers)), policy=NEWEST, depth=1)
    graph.run()
    assert slow.got == list(range(20))
    assert behind == 20 * [0]


@both
def test_a_failing_stage_ends_the_run_with_its_error(threaded: bool) -> None:
    graph, before, beside, after, closed = Graph(threaded=threaded), Collect(), Collect(), Collect(), threading.Event()

    def endless() -> Iterator[int]:
        try:
            yield from count()
        finally:
            closed.set()

    numbers = graph.source("numbers", endless)
    graph.sink("before", before, numbers)
    fragile = graph.stage("fragile", Apply(fail_at(10)), numbers)
    graph.sink("beside", beside, graph.stage("sums", Sums(), numbers))
    graph.sink("after", after, fragile)
    with pytest.raises(ValueError, match="cannot take 10") as caught:
        graph.run()
    assert caught.value.__notes__ == ["in 'fragile'"]
    assert after.got == list(range(10))
    assert [sink.finished for sink in (before, beside, after)] == [1, 1, 1]  # all are finished nevertheless
    assert before.got == list(range(len(before.got)))
    assert closed.is_set()


@both
@pytest.mark.parametrize("place", ["open", "next", "close", "finish", "sink"])
def test_raises_an_error_with_the_name_of_its_stage(threaded: bool, place: str) -> None:
    def broken() -> NoReturn:
        raise OSError(place)

    class Messages:
        def __iter__(self) -> Iterator[int]:
            return self

        def __next__(self) -> int:
            if place in ("next", "sink"):
                return 1 if place == "sink" else broken()
            raise StopIteration

        def close(self) -> None:
            if place == "close":
                broken()

    class Last(Collect):
        def process(self, message: int) -> None:
            broken()

        def finish(self) -> None:
            broken()

    graph = Graph(threaded=threaded)
    stream = graph.source("source", broken if place == "open" else Messages)
    graph.sink("sink", Last() if place in ("finish", "sink") else Collect(), stream)
    with pytest.raises(OSError, match=place) as caught:
        graph.run()
    assert caught.value.__notes__ == ["in 'sink'" if place in ("finish", "sink") else "in 'source'"]


@both
def test_stop_from_another_thread_drains_and_finishes(threaded: bool) -> None:
    graph, sink, stopped = Graph(threaded=threaded), Collect(), threading.Event()
    seen = threading.Event()

    def stop() -> None:
        assert seen.wait(LONG_S)
        graph.stop()
        stopped.set()

    def act() -> None:
        seen.set()
        assert stopped.wait(LONG_S)

    numbers = graph.source("numbers", count)
    graph.sink("sink", sink, graph.stage("pass", Apply(stopped_at(graph, 5, act)), numbers))
    stopper = threading.Thread(target=stop)
    stopper.start()
    graph.run()
    stopper.join()
    assert sink.got == list(range(graph.telemetry.stages[0].processed))  # all messages of the source
    assert len(sink.got) >= 6
    assert sink.finished == 1


@both
@pytest.mark.parametrize("handled", [True, False], ids=["SIGTERM handler", "Ctrl-C"])
def test_stop_from_a_signal_handler_drains_and_finishes(threaded: bool, handled: bool) -> None:
    graph, sink = Graph(threaded=threaded), Collect()
    number = signal.SIGTERM if handled else signal.SIGINT
    old = signal.signal(signal.SIGTERM, lambda *_: graph.stop())
    try:
        act = partial(os.kill, os.getpid(), number)
        numbers = graph.source("numbers", count)
        graph.sink("sink", sink, graph.stage("pass", Apply(stopped_at(graph, 5, act)), numbers))
        graph.run()
    finally:
        signal.signal(signal.SIGTERM, old)
    assert sink.got == list(range(graph.telemetry.stages[0].processed))
    assert len(sink.got) >= 6
    assert sink.finished == 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_interrupts_an_inline_stage() -> None:
    graph, sink = Graph(threaded=False), Collect()

    def stuck() -> None:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
        assert not threading.Event().wait(LONG_S)

    numbers = graph.source("numbers", count)
    graph.sink("sink", sink, graph.stage("stuck", Apply(stopped_at(graph, 2, stuck)), numbers))
    with pytest.raises(KeyboardInterrupt):
        graph.run()
    assert sink.got == [0, 1]
    assert sink.finished == 0


def test_refuses_wrong_wiring() -> None:
    graph = Graph()
    numbers = graph.source("numbers", lambda: range(3))
    with pytest.raises(OmnidError, match="'numbers': the name is in use"):
        graph.sink("numbers", Collect(), numbers)
    with pytest.raises(OmnidError, match="expected inputs"):
        graph.sink("nothing", Collect())
    with pytest.raises(OmnidError, match="depth above 0"):
        graph.sink("narrow", Collect(), numbers, depth=0)
    for period_s in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(OmnidError, match="period above 0"):
            graph.ticker("action", period_s, print)
    graph.run()
    with pytest.raises(OmnidError, match="runs once"):
        graph.run()
    with pytest.raises(OmnidError, match="runs once"):
        graph.source("late", lambda: range(3))
