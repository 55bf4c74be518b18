"""The graph: drop policies, end of the run, errors, stops, tickers; threads and inline give the same results."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import NoReturn

import numpy as np
import pytest

from omnid.engine.graph import LOSSLESS, NEWEST, Graph, Slot
from omnid.engine.ticker import Ticker, skipped_deadlines
from omnid.errors import OmnidError

pytestmark = pytest.mark.usefixtures("default_signals")

LONG_S = 20.0  # a timeout that only a defect reaches
both = pytest.mark.parametrize("threaded", [True, False], ids=["threaded", "inline"])


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before  # threads of other tests may have ended meanwhile


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
class Apply:
    """A stage without finish."""

    function: Callable[[int], int | None]

    def process(self, message: int) -> int | None:
        return self.function(message)


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


def stopped_at(graph: Graph, last: int, act: Callable[[], None]) -> Callable[[int], int]:
    """Return a function that passes messages on and acts at one of them."""

    def check(message: int) -> int:
        if message == last:
            act()
        return message

    return check


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


def test_lossless_waits_for_a_slow_reader_with_a_bounded_inbox() -> None:
    graph, slow = Graph(policy=LOSSLESS, depth=3), Collect()
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

    graph.sink("slow", slow, graph.stage("crawl", Apply(crawl), graph.source("numbers", numbers)))
    graph.run()
    assert slow.got == list(range(300))
    assert max(ahead) <= 3 + 2  # the inbox, one message at the writer, one at the reader
    assert [row.drops for row in graph.telemetry.summary()] == [0, 0, 0]


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


def test_a_failure_ends_the_wait_of_a_source_that_settles() -> None:
    graph = Graph(policy=LOSSLESS)

    def numbers() -> Iterator[int]:
        yield 0
        graph.settle()
        yield 1

    graph.stage("bad", Apply(fail_at(0)), graph.source("numbers", numbers))
    with pytest.raises(ValueError, match="cannot take 0"):
        graph.run()


def test_sinks_that_wait_drop_nothing() -> None:
    graph = Graph(policy=LOSSLESS, depth=1, sinks_wait=True)

    def crawl(_: int) -> None:
        threading.Event().wait(1e-4)

    graph.sink("slow", Apply(crawl), graph.source("numbers", lambda: range(200)), policy=NEWEST, depth=1)
    graph.run()
    assert (graph.telemetry.of("slow").processed, graph.telemetry.of("slow").dropped) == (200, 0)


def test_newest_drops_the_oldest_and_counts_it() -> None:
    graph, slow, fast, all_sent = Graph(policy=NEWEST, depth=2), Collect(), Collect(), threading.Event()

    def numbers() -> Iterator[int]:
        yield from range(50)
        all_sent.set()

    def hold(message: int) -> int:
        assert all_sent.wait(LONG_S)
        return message

    stream = graph.source("numbers", numbers)
    graph.sink("slow", slow, graph.stage("hold", Apply(hold), stream), policy=LOSSLESS)
    graph.sink("fast", fast, stream, policy=LOSSLESS)
    graph.run()
    assert fast.got == list(range(50))  # the policy of the sink
    assert slow.got[-2:] == [48, 49]
    assert len(slow.got) in (2, 3)  # and perhaps the first one
    counted = {stats.name: (stats.processed, stats.dropped) for stats in graph.telemetry.stages}
    assert counted["hold"] == (len(slow.got), 50 - len(slow.got))
    assert counted["numbers"] == counted["fast"] == (50, 0)


@both
def test_merges_several_sources_into_one_inbox(threaded: bool) -> None:
    graph, sink = Graph(threaded=threaded), Collect()
    streams = [graph.source("even", lambda: range(0, 100, 2)), graph.source("odd", lambda: range(1, 60, 2))]
    graph.sink("sink", sink, *streams)
    graph.run()
    assert sorted(sink.got) == sorted([*range(0, 100, 2), *range(1, 60, 2)])
    assert [number for number in sink.got if number % 2] == list(range(1, 60, 2))
    assert sink.finished == 1
    if not threaded:
        assert sink.got[:60] == list(range(60))  # inline: round robin


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


def test_a_failed_reader_releases_its_waiting_writer() -> None:
    graph, third = Graph(depth=1), threading.Event()

    def numbers() -> Iterator[int]:
        yield from (0, 1)
        third.set()  # one message in process, one in the inbox: the next one has to wait
        yield 2

    def fail(message: int) -> int:
        assert third.wait(LONG_S)
        raise ValueError(f"cannot take {message}")

    graph.stage("fragile", Apply(fail), graph.source("numbers", numbers))
    with pytest.raises(ValueError, match="cannot take 0"):
        graph.run()
    assert [(row.n, row.drops) for row in graph.telemetry.summary()] == [(3, 0), (0, 2)]


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


def test_later_errors_are_notes_of_the_first() -> None:
    class Second(Collect):
        def finish(self) -> None:
            raise OSError("the disk is full")

    graph = Graph()
    graph.sink("second", Second(), graph.stage("first", Apply(fail_at(3)), graph.source("numbers", lambda: range(9))))
    with pytest.raises(ValueError, match="cannot take 3") as caught:
        graph.run()
    assert caught.value.__notes__ == ["in 'first'", "and then: OSError('the disk is full')"]


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


def test_a_second_stop_drops_the_inboxes_and_releases_a_waiting_writer() -> None:
    graph, sink, third, ended = Graph(depth=1), Collect(), threading.Event(), threading.Event()

    def numbers() -> Iterator[int]:
        try:
            yield from (0, 1)
            third.set()  # one message in process, one in the inbox: the next one has to wait
            yield from count(2)
        finally:
            ended.set()

    def hold(message: int) -> int:
        assert third.wait(LONG_S)
        graph.stop()
        graph.stop()
        assert ended.wait(LONG_S)  # the writer was released while its reader still works
        return message

    graph.sink("sink", sink, graph.stage("hold", Apply(hold), graph.source("numbers", numbers)))
    with pytest.raises(KeyboardInterrupt, match="stopped twice"):
        graph.run()
    numbers_stats, hold_stats, _ = graph.telemetry.stages
    assert (hold_stats.processed, hold_stats.dropped) == (1, numbers_stats.processed - 1)
    assert sink.finished == 0


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


def test_an_exception_from_another_signal_handler_joins_all_threads() -> None:
    graph, sink = Graph(), Collect()

    def too_long(*_: object) -> None:
        raise TimeoutError("alarm")

    old = signal.signal(signal.SIGALRM, too_long)
    try:

        def act() -> None:
            os.kill(os.getpid(), signal.SIGALRM)
            threading.Event().wait(0.05)  # still working when the main thread raises

        numbers = graph.source("numbers", count)
        graph.sink("sink", sink, graph.stage("pass", Apply(stopped_at(graph, 5, act)), numbers))
        with pytest.raises(TimeoutError, match="alarm"):
            graph.run()
    finally:
        signal.signal(signal.SIGALRM, old)


def test_wake_ends_a_blocked_source() -> None:
    graph, sink, closed = Graph(), Collect(), threading.Event()

    def camera() -> Iterator[int]:
        yield 1
        graph.stop()
        assert closed.wait(LONG_S)

    graph.sink("sink", sink, graph.source("camera", camera, wake=closed.set))
    graph.run()
    assert (sink.got, sink.finished) == ([1], 1)


@both
def test_a_stop_before_the_run_ends_it_at_once(threaded: bool) -> None:
    graph, sink = Graph(threaded=threaded), Collect()
    graph.sink("sink", sink, graph.source("numbers", count))
    graph.stop()
    graph.run()
    assert (sink.got, sink.finished) == ([], 1)


@dataclass
class Action:
    """An action that sets an event at the call `enough` and fails at the call `bad`."""

    enough: int
    bad: int = -1
    calls: int = 0
    closed: int = 0
    reached: threading.Event = field(default_factory=threading.Event)

    def __call__(self) -> None:
        self.calls += 1
        if self.calls == self.bad:
            raise OSError("no answer from the motor")
        if self.calls >= self.enough:
            self.reached.set()

    def close(self) -> None:
        self.closed += 1


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


def test_a_stop_ends_tickers_before_the_inboxes_are_empty() -> None:
    graph, sink, action = Graph(), Collect(), Action(enough=1)
    hourly, both_closed = Action(enough=1), threading.Barrier(3)
    action.close = hourly.close = partial(both_closed.wait, LONG_S)  # type: ignore[method-assign, assignment]

    def drain_slowly(message: int) -> int:
        graph.stop()
        both_closed.wait(LONG_S)  # tickers are closed while this message is in process
        return message

    graph.sink("sink", sink, graph.stage("slow", Apply(drain_slowly), graph.source("one", lambda: [1])))
    graph.ticker("motor", 1e-3, action)
    graph.ticker("hourly", 3600.0, hourly)
    graph.run()
    assert sink.got == [1]


@pytest.mark.parametrize(
    ("late_ns", "skipped"), [(-50, 0), (0, 0), (99, 0), (100, 1), (199, 1), (1000, 10), (1050, 10)]
)
def test_skips_missed_deadlines_and_keeps_the_phase(late_ns: int, skipped: int) -> None:
    assert skipped_deadlines(5_000, 5_000 + late_ns, 100) == skipped


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


@both
def test_runs_leave_no_thread(threaded: bool) -> None:
    before = set(threading.enumerate())
    for _ in range(200):
        graph, sink = Graph(threaded=threaded), Collect()
        graph.sink("sink", sink, graph.stage("sums", Sums(), graph.source("numbers", lambda: range(5))))
        graph.ticker("action", 1e-3, Action(enough=1))
        graph.run()
        assert sink.got == [1, 5, 4, -1]
        assert set(threading.enumerate()) <= before


@both
def test_threads_have_the_names_of_their_stages(threaded: bool) -> None:
    names: list[str] = []
    graph = Graph(threaded=threaded)
    where = Apply(lambda _: names.append(threading.current_thread().name))
    graph.stage("where", where, graph.source("one", lambda: [1]))
    graph.run()
    assert names == ["where" if threaded else threading.current_thread().name]


@both
def test_a_slot_as_a_sink_keeps_the_newest(threaded: bool) -> None:
    slot: Slot[int] = Slot()
    assert slot.get() is None
    graph = Graph(threaded=threaded)
    graph.sink("newest", slot, graph.source("numbers", lambda: range(10)))
    graph.run()
    assert slot.get() == 9
    slot.put(3)
    assert slot.get() == 3


def test_runs_outside_the_main_thread() -> None:
    graph, sink = Graph(), Collect()
    graph.sink("sink", sink, graph.source("numbers", lambda: range(3)))
    thread = threading.Thread(target=graph.run)
    thread.start()
    thread.join()
    assert sink.got == [0, 1, 2]


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


def test_of_two_writers_each_drops_its_own_oldest_message() -> None:
    """So a camera never takes the place of the other one's image."""
    graph, gate, out = Graph(policy=NEWEST, depth=1), threading.Event(), Collect()
    sent = [threading.Event(), threading.Event()]

    def numbers(offset: int, done: threading.Event) -> Iterator[int]:
        yield from range(offset, offset + 5)
        done.set()

    class Slow:
        def process(self, number: int) -> int:
            if not gate.is_set():
                for event in sent:
                    event.wait(5)
                gate.set()
            return number

    lower = graph.source("lower", lambda: numbers(0, sent[0]))
    upper = graph.source("upper", lambda: numbers(100, sent[1]))
    graph.sink("out", out, graph.stage("slow", Slow(), lower, upper), policy=LOSSLESS)
    graph.run()
    assert {4, 104} <= set(out.got)


class Held:
    """Holds the first message until all were sent; of dropped messages it keeps the parts."""

    def __init__(self, all_sent: threading.Event) -> None:
        self._all_sent = all_sent

    def process(self, parts: tuple[int, ...]) -> tuple[int, ...]:
        assert self._all_sent.wait(LONG_S)
        return parts

    def merge(self, older: tuple[int, ...], newer: tuple[int, ...]) -> tuple[int, ...]:
        return older + newer


@pytest.mark.parametrize("depth", [1, 3])
def test_parts_of_dropped_messages_go_along_with_the_next_one_of_their_writer(depth: int) -> None:
    graph, out, all_sent = Graph(policy=NEWEST, depth=depth), Collect(), threading.Event()
    sent = [threading.Event(), threading.Event()]

    def parts(first: int, done: threading.Event) -> Iterator[tuple[int, ...]]:
        yield from ((number,) for number in range(first, first + 20))
        done.set()
        if all(event.is_set() for event in sent):
            all_sent.set()

    streams = [
        graph.source(name, partial(parts, first, done)) for name, first, done in zip("ab", (0, 100), sent, strict=True)
    ]
    graph.sink("out", out, graph.stage("held", Held(all_sent), *streams), policy=LOSSLESS)
    graph.run()
    found = [number for message in out.got for number in message]
    assert len(out.got) <= 2 * depth + 1 and graph.telemetry.of("held").dropped == 40 - len(out.got)
    for first in (0, 100):  # nothing is lost, twice or mixed, and the newest messages are whole by themselves
        assert [number for number in found if number // 100 == first // 100] == list(range(first, first + 20))
        assert depth == 1 or (first + 19,) in out.got
    assert all(len({number // 100 for number in message}) == 1 for message in out.got)


class Recorded:
    """Passes numbers on after an optional wait, and keeps what it was given."""

    def __init__(self, wait_s: float = 0.0) -> None:
        self.seen: list[int] = []
        self._wait_s = wait_s

    def process(self, number: int) -> int:
        self.seen.append(number)
        time.sleep(self._wait_s)
        return number


@pytest.mark.parametrize("bound", [True, False])
def test_a_bound_head_works_only_for_what_the_tail_will_take(bound: bool) -> None:
    """Without the bound, the head's work on most messages is dropped in front of the slow tail."""
    graph, head, tail = Graph(policy=NEWEST, depth=1), Recorded(), Recorded(0.03)

    def numbers() -> Iterator[int]:
        for number in range(200):
            time.sleep(0.001)
            yield number

    graph.sink("tail", tail, graph.stage("head", head, graph.source("numbers", numbers)))
    if bound:
        graph.bound("head", "tail")
    graph.run()
    assert tail.seen[-1] == 199  # the last one is not lost
    assert (len(head.seen) <= len(tail.seen) + 1) == bound


def test_after_long_work_that_follows_a_result_the_tail_takes_the_newest() -> None:
    """A message prepared for it during its own work has become old meanwhile."""
    made: list[int] = []  # numbers so far, of which the last one is the newest
    ages: list[int] = []  # how many newer ones there were when the tail took one after its long work
    during: list[int] = []  # how many were made during that

    class Tail:
        after_work = False
        taken = 0

        def process(self, number: int) -> None:
            if self.after_work:
                ages.append(made[-1] - number)
            self.taken += 1
            self.after_work = self.taken % 5 == 0
            time.sleep(0.005)

        def after(self) -> None:
            if self.after_work:
                before = made[-1]
                time.sleep(0.06)
                during.append(made[-1] - before)

    def numbers() -> Iterator[int]:
        for number in range(600):
            made.append(number)
            time.sleep(0.001)
            yield number

    graph = Graph(policy=NEWEST, depth=1)
    graph.sink("tail", Tail(), graph.stage("head", Recorded(0.003), graph.source("numbers", numbers)))
    graph.bound("head", "tail")
    graph.run()
    assert np.median(ages) < np.median(during) / 2


def test_a_bound_head_ends_with_a_tail_that_fails() -> None:
    class Failing:
        def process(self, number: int) -> None:
            raise ValueError("broken")

    graph = Graph(policy=NEWEST, depth=1)
    graph.sink("tail", Failing(), graph.stage("head", Recorded(), graph.source("numbers", lambda: iter(range(50)))))
    graph.bound("head", "tail")
    with pytest.raises(ValueError, match="broken"):
        graph.run()


def test_direct_stages_and_sinks_run_in_the_thread_of_the_one_before() -> None:
    names: list[str] = []

    class Named:
        def process(self, number: int) -> int:
            names.append(threading.current_thread().name)
            return number

    graph, out = Graph(), Collect()
    first = graph.stage("first", Named(), graph.source("numbers", lambda: iter(range(3))))
    graph.sink("out", out, graph.stage("second", Named(), first, direct=True))
    graph.sink("third", Named(), first, direct=True)
    graph.run()
    assert set(names) == {"first"} and out.got == [0, 1, 2]
    assert [stats.processed for stats in graph.telemetry.stages if stats.name in ("second", "third")] == [3, 3]
