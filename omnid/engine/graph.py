"""The graph of stages and its threads: inboxes, the end of a run, failures.

A stream exists before it is read, so a cycle cannot be wired. A thread has one bounded inbox, from which it serves its
stages in the order of arrival; between stages of one thread messages pass directly. The end of a stream is the last
message of it. Inline, the same stages run in the caller's thread, each message depth first, with the same results.
Where streams of several threads merge, only the inline order is fixed.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from types import FrameType
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.process import handle_stop_signals

Lock = threading.Lock
POLL_S: Final = 0.1  # Longest wait between two checks for an end: a signal in another thread wakes no main thread.
RECENT: Final = 1000  # durations whose distribution is known: ten seconds of the controller's ticks
T = TypeVar("T")
In = TypeVar("In")
Out = TypeVar("Out")
T_co = TypeVar("T_co", covariant=True)
Out_co = TypeVar("Out_co", covariant=True)
In_contra = TypeVar("In_contra", contravariant=True)
END: Final = object()  # the last message of a stream


def run_in_thread(action: Callable[[], object], name: str) -> threading.Thread:
    """Call an action in a daemon thread, and return the thread; an error is printed."""
    thread = threading.Thread(target=action, name=name, daemon=True)
    thread.start()
    return thread


def sleep_until(due_ns: int, is_over: Callable[[], bool]) -> None:
    """Sleep until a time by CLOCK_MONOTONIC, or until is_over() returns True."""
    while not is_over() and (left_s := (due_ns - time.monotonic_ns()) * S_PER_NS) > 0:
        time.sleep(min(left_s, POLL_S))  # half the processor time of a wait for an event


class Poller:
    """Calls an action each period until it is closed; what the action raises is printed, and the calls go on."""

    def __init__(self, action: Callable[[], object], period_s: float, name: str) -> None:
        self._action, self._period_ns = action, round(period_s * NS_PER_S)
        self._closing = False
        self._thread = run_in_thread(self._run, name)

    def close(self) -> None:
        """End the calls; a running one ends first, unless this is it."""
        self._closing = True
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while not self._closing:
            due_ns = time.monotonic_ns() + self._period_ns
            try:
                self._action()
            except Exception:  # Stops arrive in such a thread: it must not end by a defect elsewhere.
                traceback.print_exc(file=sys.stderr)
            sleep_until(due_ns, lambda: self._closing)


class Histogram:
    """Distribution of the newest durations [s], their number, and the longest of all; one thread adds, any reads."""

    def __init__(self) -> None:
        self._recent_s: deque[float] = deque(maxlen=RECENT)
        self.count = 0
        self.max_s = math.nan

    def add(self, duration_s: float) -> None:
        """Add one duration."""
        self._recent_s.append(duration_s)
        self.max_s = duration_s if self.count == 0 else max(self.max_s, duration_s)
        self.count += 1

    def p(self, q: float) -> float:
        """Return the quantile q (0 to 1) of the newest durations, s; NaN before the first."""
        found_s = sorted(self._recent_s.copy())
        return found_s[max(0, math.ceil(q * len(found_s)) - 1)] if found_s else math.nan

    def times_ms(self, name: str = "") -> dict[str, float]:
        """Return median, 99th percentile and maximum, ms; NaN before the first. name: begins their keys."""
        found_s = {"p50": self.p(0.5), "p99": self.p(0.99), "max": self.max_s}
        return {f"{name}_{key}_ms".lstrip("_"): 1e3 * value_s for key, value_s in found_s.items()}


@dataclass(slots=True)
class StageStats:
    """Counters of one stage, source or sink: written by its own thread, `dropped` under its inbox's lock.

    A source's durations are the waits for its next message. `busy_since_ns` (CLOCK_MONOTONIC): since when a message is
    processed; 0 when idle.
    """

    processed: int = 0
    dropped: int = 0
    busy_since_ns: int = 0
    wall: Histogram = field(default_factory=Histogram)

    def timed(self, call: Callable[..., T], *args: Any) -> T:
        """Return `call(*args)`, counted and timed; a call that raises is not counted."""
        start_ns = self.busy_since_ns = time.monotonic_ns()
        try:
            result = call(*args)
        finally:
            self.busy_since_ns = 0
        self.wall.add((time.monotonic_ns() - start_ns) * S_PER_NS)
        self.processed += 1
        return result


class Stage(Protocol[In_contra, Out_co]):
    """A step of the flow.

    It may also have `finish() -> Iterable[Out]` for the results left at the end, and `complete()` for work that begins
    when the result of a message has been passed on, so that no reader waits for it.
    """

    def process(self, message: In_contra, /) -> Out_co | None:
        """Return the result of the message, None without one; a sink, which is an end of the flow, returns None."""


# A stage or a sink without a state, and without results at the end, is a function.
Step: TypeAlias = Stage[In_contra, Out_co] | Callable[[In_contra], Out_co | None]


def no_op(*_: object) -> None:
    """Do nothing: used in place of a method that a stage does not have."""


class Stream(Generic[T_co]):
    """Output of a source or a stage, with any number of readers, which get each message in the order of the wiring."""

    def __init__(self, thread: str = "", depth: int = 0) -> None:
        """thread: name of the thread that pushes the messages; empty: any. depth: see Graph.inlet; 0: of a stage."""
        self.thread, self.depth = thread, depth
        self.readers: list[Callable[[object], None]] = []

    def push(self, message: object) -> None:
        """Pass the message to every reader; END is the last one."""
        for put in self.readers:
            put(message)


class _Node:
    """A stage or a sink with its counters and its output; after an error it drops its messages, and counts them."""

    def __init__(self, graph: Graph, name: str, work: Any, inputs: Sequence[Stream[Any]], thread: str) -> None:
        """thread: name of the thread in which it runs."""
        self.stats, self.writers, self._graph, self._work = graph.counters(name), len(inputs), graph, work
        self.name, self.inputs, self.depth, self.is_end = name, inputs, 0, False
        self.stream: Stream[Any] = Stream(thread)
        self._complete: Callable[[], object] = no_op
        if hasattr(work, "complete"):
            self._complete = partial(graph.counters(f"{name} completion").timed, work.complete)

    def put(self, message: object) -> None:
        """Process the message, and pass on its result; at the end of the last input, the remaining results and END."""
        graph, name = self._graph, self.name
        has_failed = name in graph.failed
        if message is END:
            self.writers -= 1
            if not self.writers:
                finish = no_op if has_failed else getattr(self._work, "finish", no_op)
                with graph.catch_failure(name):
                    for result in finish() or ():
                        self.stream.push(result)
                self.stream.push(END)
        elif has_failed or not self.writers:
            self.stats.dropped += 1
        else:
            with graph.catch_failure(name):
                result = self.stats.timed(getattr(self._work, "process", self._work), message)
                if result is not None:
                    self.stream.push(result)
                self._complete()


class _Inbox:
    """Bounded queues in front of a thread, from which it serves its nodes in the order of arrival.

    A full queue lets the writer wait, or drops its oldest message and keeps the place in the order: no camera displaces
    an image of the other one.
    """

    def __init__(self, graph: Graph) -> None:
        self._graph, self._changed = graph, threading.Condition(graph.lock)
        self._order: deque[tuple[_Node, deque[object]]] = deque()
        self._open = 0  # streams that have not ended

    def reader(self, node: _Node, depth: int, *, drops: bool) -> Callable[[object], None]:
        """Return the function that adds a message of a stream for a node; END always has room."""
        waiting = deque[object]()
        self._open += 1

        def put(message: object) -> None:
            with self._changed:
                if message is not END and not drops:
                    self._changed.wait_for(lambda: len(waiting) < depth)
                if waiting and waiting[-1] is END:  # A message from outside after END, which it would displace.
                    node.stats.dropped += 1
                    return
                waiting.append(message)
                if message is not END and len(waiting) > depth:
                    waiting.popleft()
                    node.stats.dropped += 1
                    return
                self._order.append((node, waiting))
                self._graph.waiting += 1
                self._changed.notify_all()

        return put

    def serve(self) -> None:
        """Pass the messages to their nodes until all streams have ended."""
        while self._open:
            with self._changed:
                self._changed.wait_for(lambda: self._order)
                node, waiting = self._order.popleft()
                message = waiting.popleft()
                self._changed.notify_all()
            self._open -= message is END
            node.put(message)
            with self._graph.idle:
                self._graph.waiting -= 1
                if not self._graph.waiting:
                    self._graph.idle.notify_all()


class Graph:
    """The wiring of one run, and the run itself.

    `drops`: a full inbox drops its oldest message and counts it; else the writer waits, and nothing is lost. `depth` is
    the capacity of an inbox for each stream. `on_thread` is called in each thread, with its name, before its work; it
    must not raise.
    """

    def __init__(
        self,
        *,
        drops: bool = False,
        threaded: bool = True,
        depth: int = 2,
        on_thread: Callable[[str], object] = no_op,
    ) -> None:
        self.stats: dict[str, StageStats] = {}  # by name, in the order of the wiring
        self.drops, self.threaded = drops, threaded
        self._depth, self._on_thread = depth, on_thread
        self.lock = threading.Lock()  # of all inboxes
        self.idle = threading.Condition(self.lock)
        self.waiting = 0  # messages in all inboxes and in process; under the lock
        self._sources: dict[str, Callable[[], object]] = {}  # bodies of the threads of sources, by their names
        self._wakes: dict[str, Callable[[], None]] = {}
        self._inlets: list[Stream[Any]] = []
        self._nodes: list[_Node] = []  # that are not attached to their inputs yet
        self._inboxes: dict[str, _Inbox] = {}  # by thread
        self.failed: set[str] = set()  # names of stages
        self._errors: list[BaseException] = []
        self.signal = 0  # number of the signal that ended the run
        self._open_sources = 0

    # The wiring.

    def counters(self, name: str) -> StageStats:
        """Return new counters, whose name is that of no other stage."""
        assert name not in self.stats, name
        return self.stats.setdefault(name, StageStats())

    def source(self, name: str, messages: Callable[[], Iterable[T]], *, wake: Callable[[], None] = no_op) -> Stream[T]:
        """Add a source: an iterable that is opened, read and closed in the source's own thread.

        `wake` is called once to end a threaded run early: it must end the current read and all later ones. Inline,
        sources are read one after the other.
        """
        self.counters(name)
        stream: Stream[T] = Stream(name)
        self._sources[name] = partial(self._run_source, name, messages, stream)
        self._wakes[name] = wake
        self._open_sources += 1
        return stream

    def inlet(self, depth: int, thread: str = "") -> Stream[Any]:
        """Add a stream for messages from outside; it ends when all sources have ended.

        depth: number of messages that may wait for each reader; the oldest give way, so that the writer never waits.
        0: as the graph has it for other streams. thread: name of the thread that pushes them, whose stages then run
        there; empty: any.
        """
        self._inlets.append(Stream(thread, depth))
        return self._inlets[-1]

    def stage(self, name: str, stage: Step[In, Out], *inputs: Stream[In], thread: str = "") -> Stream[Out]:
        """Add a stage, whose inputs merge; return its output. A stage whose output has no reader does not run.

        thread: name of the thread in which it runs; empty: its own. Messages within a thread are passed on directly,
        without an inbox.
        """
        self._nodes.append(_Node(self, name, stage, inputs, thread or name))
        return self._nodes[-1].stream

    def sink(
        self, name: str, sink: Step[In, Out], *inputs: Stream[In], thread: str = "", depth: int = 0
    ) -> Stream[Out]:
        """Add a stage that runs without a reader, too. depth: of its inbox, if not that of the graph."""
        output = self.stage(name, sink, *inputs, thread=thread)
        self._nodes[-1].is_end, self._nodes[-1].depth = True, depth
        return output

    def connect(self) -> None:
        """End the wiring: attach all that is read to its inputs. `run` does it, unless inlets are to work before."""
        while self._nodes:
            node = self._nodes.pop()
            if not (node.is_end or node.stream.readers):
                del self.stats[node.name]
                continue
            # From the last stage to the first: its readers are known, and are served in the order of the wiring.
            thread = node.stream.thread
            for stream in node.inputs:
                put: Callable[[object], None] = node.put
                if self.threaded and stream.thread != thread:
                    inbox = self._inboxes.setdefault(thread, _Inbox(self))
                    depth = stream.depth or node.depth or self._depth
                    put = inbox.reader(node, depth, drops=self.drops or bool(stream.depth))
                stream.readers.insert(0, put)

    # The run.

    def run(self) -> None:
        """Run until all sources have ended and all threads have joined; only once.

        Raises the first error of any stage with later ones in its notes.
        """
        # 1. A thread for each source and each group of stages.
        self.connect()
        bodies = self._sources | {name: inbox.serve for name, inbox in self._inboxes.items()}
        threads = [threading.Thread(target=self._begin, args=body, name=body[0]) for body in bodies.items()]
        if not self.threaded:
            threads = []
        # 2. Run, and wait for the end of all.
        try:
            for thread in threads:
                thread.start()
            for run_source in () if self.threaded else self._sources.values():
                run_source()
            self._join(threads)
        except BaseException as error:  # A signal handler has raised it, or no thread could be started.
            self._errors.insert(0, error)
            self._join(threads)
        # 3. Raise the first error.
        for later in self._errors[1:]:
            self._errors[0].add_note(f"and then: {later!r}")
        if self._errors:
            raise self._errors[0]

    def signals(self) -> AbstractContextManager[None]:
        """Return a context in which SIGINT, SIGTERM and SIGHUP end the sources: what is in the inboxes is done.

        Ctrl-C after one of them ends the process at once; the controller process stops the wheels, as after any end. A
        terminal that closes may send SIGHUP twice.
        """

        def handle(number: int, _: FrameType | None) -> None:
            if self.signal and number == signal.SIGINT:
                os._exit(128 + number)
            self.signal = number

        return handle_stop_signals(handle)

    def settle(self) -> None:
        """Wait until all messages have been processed, or the run ends: for a source whose time is stopped meanwhile.

        Inline, nothing ever waits.
        """
        with self.idle:
            while not self.is_stopping and not self.idle.wait_for(lambda: not self.waiting, POLL_S):
                pass

    @property
    def is_stopping(self) -> bool:
        """True after a signal or a failure."""
        return bool(self.signal or self._errors)

    @contextmanager
    def catch_failure(self, name: str) -> Iterator[None]:
        """Keep an error of this block, end the run, and mark the stage as failed."""
        try:
            yield
        except BaseException as error:
            error.add_note(f"in '{name}'")
            self.failed.add(name)
            self._errors.append(error)

    def _begin(self, name: str, body: Callable[[], object]) -> None:
        self._on_thread(name)
        body()

    def _run_source(self, name: str, begin: Callable[[], Iterable[object]], stream: Stream[Any]) -> None:
        """Pass on the messages of a source; then end its stream, and after the last source the inlets."""
        stats, messages = self.stats[name], iter(tuple[object]())
        with self.catch_failure(name):
            try:
                messages, start_ns = iter(() if self.is_stopping else begin()), time.monotonic_ns()
                for message in messages:
                    stats.wall.add((time.monotonic_ns() - start_ns) * S_PER_NS)
                    stats.processed += 1
                    stream.push(message)
                    if self.is_stopping:
                        break
                    start_ns = time.monotonic_ns()
            finally:
                getattr(messages, "close", no_op)()
        stream.push(END)
        with self.lock:
            self._open_sources -= 1
            is_last = not self._open_sources
        for inlet in self._inlets if is_last else ():
            inlet.push(END)

    def _join(self, threads: list[threading.Thread]) -> None:
        """Wait for the threads that were started; pass a signal or a failure on to the sources."""
        for thread in threads:
            while thread.is_alive():
                thread.join(POLL_S)
                while self.is_stopping and self._wakes:
                    name, wake = self._wakes.popitem()
                    with self.catch_failure(name):
                        wake()
