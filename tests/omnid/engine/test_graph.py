"""The graph: inboxes, the end of the run, errors, stops; threads and inline give the same results."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import count

import pytest

from omnid.engine.graph import END, Graph
from omnid.engine.process import python

LONG_S = 20.0  # a timeout that only a defect reaches


both = pytest.mark.parametrize("threaded", [True, False], ids=["threaded", "inline"])


@dataclass
class Collect:
    """A sink that keeps its messages and counts calls of finish."""

    got: list[int] = field(default_factory=list)
    finished: int = 0

    def process(self, message: int) -> None:
        self.got.append(message)

    def finish(self) -> None:
        self.finished += 1


@dataclass
class Sums:
    """A stage with state: sums of two messages; at the end the message left over and a marker."""

    held: list[int] = field(default_factory=list)

    def process(self, message: int) -> int | None:
        self.held.append(message)
        if len(self.held) < 2:
            return None
        total, self.held = sum(self.held), []
        return total

    def finish(self) -> Iterable[int]:
        yield from self.held
        yield -1


def fail_at(bad: int) -> Callable[[int], int]:
    def check(message: int) -> int:
        if message == bad:
            raise ValueError(f"cannot take {message}")
        return message

    return check


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before  # threads of other tests may have ended meanwhile


pytestmark = pytest.mark.usefixtures("default_signals")


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
    graph, slow = Graph(threaded=threaded), Collect()
    behind: list[int] = []

    done: list[int] = []

    def later(message: int) -> None:
        threading.Event().wait(1e-3)
        done.append(message)

    def numbers() -> Iterator[int]:
        for number in range(20):
            yield number
            graph.settle()
            behind.append(2 * number + 2 - len(done) - len(slow.got))

    passed = graph.stage("pass", lambda message: message, graph.source("numbers", numbers))
    graph.sink("slow", slow, passed)
    graph.sink("later", later, passed, thread=passed.thread)  # the last reader, in the thread of its stage
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
    fragile = graph.stage("fragile", fail_at(10), numbers)
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
def test_a_stop_by_a_signal_drains_and_finishes(threaded: bool) -> None:
    graph, sink = Graph(threaded=threaded), Collect()

    def stop_at_5(message: int) -> int:
        if message == 5:
            os.kill(os.getpid(), signal.SIGTERM)
        return message

    graph.sink("sink", sink, graph.stage("pass", stop_at_5, graph.source("numbers", count)))
    with graph.signals():
        graph.run()
    assert sink.got == list(range(graph.stats["numbers"].processed))  # all messages of the source
    assert len(sink.got) >= 6 and sink.finished == 1


STUCK = """
import os, signal, time
from omnid.engine.graph import END, Graph
from omnid.engine.process import python

def stuck(_):
    os.kill(os.getpid(), signal.SIGTERM)
    while not graph.signal:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)
    while True:
        time.sleep(0.01)

graph = Graph()
graph.sink("stuck", stuck, graph.source("numbers", lambda: range(3)))
with graph.signals():
    graph.run()
"""


def test_ctrl_c_after_a_signal_ends_the_process_at_once() -> None:
    assert subprocess.run(python("-c", STUCK), timeout=LONG_S).returncode == 128 + signal.SIGINT


def test_a_replay_waits_for_a_slow_reader_with_a_bounded_inbox() -> None:
    graph, slow = Graph(depth=3), Collect()
    produced: list[int] = []
    ahead: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(300):
            produced.append(number)
            yield number

    def crawl(message: int) -> int:
        threading.Event().wait(1e-4)
        ahead.append(len(produced) - message)
        return message

    graph.sink("slow", slow, graph.stage("crawl", crawl, graph.source("numbers", numbers)))
    graph.run()
    assert slow.got == list(range(300))
    assert max(ahead) <= 3 + 2  # the inbox, one message at the writer, one at the reader
    assert [one.dropped for one in graph.stats.values()] == [0, 0, 0]


def test_a_live_inbox_drops_the_oldest_message_and_counts_it() -> None:
    graph, slow, fast, all_sent = Graph(drops=True, depth=2), Collect(), Collect(), threading.Event()

    def numbers() -> Iterator[int]:
        yield from range(50)
        all_sent.set()

    def hold(message: int) -> int:
        assert all_sent.wait(LONG_S)
        return message

    stream = graph.source("numbers", numbers)
    graph.sink("slow", slow, graph.stage("hold", hold, stream), depth=4)
    graph.sink("fast", fast, stream, depth=50)
    graph.run()
    assert fast.got == list(range(50))  # the depth of the sink
    assert slow.got[-2:] == [48, 49]
    assert len(slow.got) in (2, 3)  # and perhaps the first one
    counted = {name: (stats.processed, stats.dropped) for name, stats in graph.stats.items()}
    assert counted["hold"] == (len(slow.got), 50 - len(slow.got))
    assert counted["numbers"] == counted["fast"] == (50, 0)


def test_stages_of_one_thread_share_it_and_pass_messages_directly() -> None:
    graph, seen = Graph(drops=True, depth=1), Counter[tuple[str, str]]()
    last, beside = Collect(), Collect()

    def noted(name: str) -> Callable[[int], int]:
        def note(message: int) -> int:
            seen[name, threading.current_thread().name] += 1
            return message

        return note

    numbers = graph.source("numbers", lambda: range(100))
    first = graph.stage("first", noted("first"), numbers, thread="shared")
    graph.sink("last", last, graph.stage("second", noted("second"), first, thread="shared"), thread="shared")
    graph.sink("other", noted("other"), numbers, thread="shared")
    graph.sink("beside", beside, first, depth=100)
    graph.run()
    of_first = graph.stats["first"]
    assert of_first.processed + of_first.dropped == 100 and last.got[-1] == 99
    assert last.got == beside.got and last.finished == beside.finished == 1, "nothing is dropped between the two"
    assert {thread for _, thread in seen} == {"shared"} and seen["first", "shared"] == seen["second", "shared"]
    assert {name for name, _ in seen} == {"first", "second", "other"}


def test_a_message_from_outside_after_the_end_is_dropped() -> None:
    graph, sink, has_ended = Graph(drops=True, depth=1), Collect(), threading.Event()
    inlet = graph.inlet(1)

    def slow(message: int) -> int:
        has_ended.wait()
        return message

    def late(message: object) -> None:
        if message is END:
            inlet.push(2)
            has_ended.set()

    graph.sink("sink", sink, graph.stage("slow", slow, inlet))
    inlet.readers.append(late)
    graph.source("numbers", lambda: map(inlet.push, [1]))
    graph.run()
    assert sink.got == [1] and sink.finished == 1


@both
def test_messages_from_outside_are_accepted_until_the_sources_end(threaded: bool) -> None:
    graph, sink = Graph(threaded=threaded), Collect()
    inlet = graph.inlet(3)

    def numbers() -> Iterator[int]:
        for number in range(3):
            inlet.push(10 + number)
            yield number

    stage = graph.stage("both", lambda message: message, inlet, graph.source("numbers", numbers))
    graph.sink("sink", sink, stage)
    graph.run()
    inlet.push(99)
    assert sorted(sink.got) == [0, 1, 2, 10, 11, 12] and sink.finished == 1
