"""The graph of stages and its threads: inboxes, tickers, the end of a run.

A stream exists before it is read, so a cycle cannot be wired. A thread has one bounded inbox, from which it serves its
stages in the order of arrival; between stages of one thread messages pass directly. The end of a stream is the last
message of it. Inline, the same stages run in the caller's thread, each message depth first, with the same results.
Where streams of several threads merge, only the inline order is fixed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.telemetry import StageStats, Telemetry
from omnid.engine.threads import POLL_S

T = TypeVar("T")
In = TypeVar("In")
Out = TypeVar("Out")
T_co = TypeVar("T_co", covariant=True)
Out_co = TypeVar("Out_co", covariant=True)
In_contra = TypeVar("In_contra", contravariant=True)
END: Final = object()  # the last message of a stream


class Policy(Enum):
    """Policy of a full inbox: LOSSLESS lets the writer wait, NEWEST drops the oldest message and counts it."""

    LOSSLESS = "lossless"
    NEWEST = "newest"


LOSSLESS: Final = Policy.LOSSLESS
NEWEST: Final = Policy.NEWEST


class Stage(Protocol[In_contra, Out_co]):
    """A step of the flow; may also have `finish() -> Iterable[Out]` for the results left at the end."""

    def process(self, message: In_contra, /) -> Out_co | None:
        """Return the result of the message, None without one."""


class Sink(Protocol[In_contra]):
    """An end of the flow; may also have `finish() -> None`."""

    def process(self, message: In_contra, /) -> None:
        """Take a message out of the graph."""


# A stage or a sink without a state, and without results at the end, is a function.
Step: TypeAlias = Stage[In_contra, Out_co] | Callable[[In_contra], Out_co | None]
Output: TypeAlias = Sink[In_contra] | Callable[[In_contra], None]


def nothing(*_: object) -> None:
    """Do nothing: used in place of a method that a stage does not have."""


class Stream(Generic[T_co]):
    """Output of a source or a stage, with any number of readers, which get each message in the order of the wiring."""

    def __init__(self, thread: str = "", depth: int = 0) -> None:
        """thread: name of that in which the messages are pushed; empty: any. depth: see Graph.inlet; 0: of a stage."""
        self.thread, self.depth = thread, depth
        self.readers: list[Callable[[object], None]] = []

    def push(self, message: object) -> None:
        """Pass the message to every reader; END is the last one."""
        for put in self.readers:
            put(message)


class Node:
    """A stage or a sink with its counters and its output; after an error it drops its messages, and counts them."""

    def __init__(self, graph: Graph, stats: StageStats, work: Any, writers: int, thread: str) -> None:
        """writers: number of streams that it reads."""
        self.stats, self.writers, self._graph = stats, writers, graph
        self.stream: Stream[Any] = Stream(thread)
        self._process: Callable[[object], object | None] = getattr(work, "process", work)
        self._finish: Callable[[], Iterable[object] | None] = getattr(work, "finish", nothing)

    def put(self, message: object) -> None:
        """Process the message, and pass its result on; at the end of the last input what remains, and the end."""
        graph, name = self._graph, self.stats.name
        is_over = graph.aborting or name in graph.failed
        if message is END:
            self.writers -= 1
            if not self.writers:
                with graph.watched(name):
                    for result in () if is_over else self._finish() or ():
                        self.stream.push(result)
                self.stream.push(END)
        elif is_over or not self.writers:
            self.stats.dropped += 1
        else:
            with graph.watched(name):
                result = self.stats.timed(self._process, message)
                if result is not None:
                    self.stream.push(result)


@dataclass(slots=True, eq=False)
class _Link:
    """One of the streams that a node reads, with what waits of it and the bound of that."""

    node: Node
    depth: int
    policy: Policy
    waiting: deque[object] = field(default_factory=deque)


class _Inbox:
    """Bounded queues in front of a thread, from which it serves its nodes in the order of arrival.

    With the policy NEWEST a stream drops its own oldest message, whose place in the order its next one takes: none of
    two cameras takes the place of the other one's image.
    """

    def __init__(self, graph: Graph) -> None:
        self.nodes: set[Node] = set()
        self._graph, self._changed = graph, threading.Condition(graph.lock)
        self._order: deque[_Link] = deque()

    def put(self, link: _Link, message: object) -> None:
        """Add a message of a stream; the end of one always has room."""
        waiting = link.waiting
        with self._changed:
            if message is not END and link.policy is LOSSLESS:
                self._changed.wait_for(lambda: len(waiting) < link.depth)
            waiting.append(message)
            if message is not END and len(waiting) > link.depth:
                waiting.popleft()
                link.node.stats.dropped += 1
                return
            self._order.append(link)
            self._graph.waiting += 1
            self._changed.notify_all()

    def serve(self) -> None:
        """Pass the messages to their nodes until all streams of these have ended."""
        while any(node.writers for node in self.nodes):
            with self._changed:
                self._changed.wait_for(lambda: self._order)
                link = self._order.popleft()
                message = link.waiting.popleft()
                self._changed.notify_all()
            link.node.put(message)
            self._graph.done()


class Graph:
    """The wiring of one run, and the run itself.

    `policy` is that of all inboxes unless a sink has its own; `depth` is the capacity of an inbox for each stream.
    `sinks_wait`: sinks have no policy of their own, so with LOSSLESS no message is ever dropped.
    `on_thread` is called in each thread, with its name, before its work; it must not raise.
    """

    def __init__(
        self,
        *,
        policy: Policy = LOSSLESS,
        threaded: bool = True,
        depth: int = 2,
        sinks_wait: bool = False,
        on_thread: Callable[[str], object] = nothing,
    ) -> None:
        self.telemetry, self.policy = Telemetry(), policy
        self._threaded, self._depth, self._on_thread, self._sinks_wait = threaded, depth, on_thread, sinks_wait
        self.lock = threading.Lock()  # of all inboxes
        self._idle = threading.Condition(self.lock)
        self.waiting = 0  # messages in all inboxes, with those that are processed; under the lock
        self._readers: dict[str, Callable[[], object]] = {}  # bodies of the threads of sources, by their names
        self._wakes: dict[str, Callable[[], None]] = {}
        self._inlets: list[Stream[Any]] = []
        self._inboxes: dict[str, _Inbox] = {}  # by thread
        self._tickers: dict[str, Callable[[], object]] = {}  # bodies of their threads, by their names
        self.failed: set[str] = set()  # names of stages
        self._errors: list[BaseException] = []
        self._stops: deque[None] = deque(maxlen=2)
        self._no_ticks = threading.Event()
        self._open_sources = 0

    # The wiring.

    def source(
        self, name: str, messages: Callable[[], Iterable[T]], *, wake: Callable[[], None] = nothing
    ) -> Stream[T]:
        """Add a source: an iterable that is opened, read and closed in the source's own thread.

        `wake` is called once to end a threaded run early: it must end the current read and all later ones. Inline,
        sources are read one after the other.
        """
        stream: Stream[T] = Stream(name)
        self._readers[name] = partial(self._read, self.telemetry.add(StageStats(name)), messages, stream)
        self._wakes[name] = wake
        self._open_sources += 1
        return stream

    def inlet(self, depth: int, thread: str = "") -> Stream[Any]:
        """Add a stream for messages from outside, which never waits; it ends when all sources have ended.

        depth: number of messages that may wait for each reader; the oldest give way. thread: name of the thread that
        pushes them, whose stages then run there; empty: any.
        """
        self._inlets.append(Stream(thread, depth))
        return self._inlets[-1]

    def stage(self, name: str, stage: Step[In, Out], *inputs: Stream[In], thread: str = "") -> Stream[Out]:
        """Add a stage, whose inputs merge; return its output.

        thread: name of that in which it runs, one of its own where it is empty. What comes from a stage or a source of
        the same thread is passed on directly, without an inbox.
        """
        return self._node(name, stage, inputs, self.policy, self._depth, thread)

    def sink(
        self,
        name: str,
        sink: Output[In],
        *inputs: Stream[In],
        policy: Policy | None = None,
        depth: int | None = None,
        thread: str = "",
    ) -> None:
        """Add a sink, with its own policy or depth if given; thread as of a stage."""
        own = None if self._sinks_wait else policy
        self._node(name, sink, inputs, own or self.policy, self._depth if depth is None else depth, thread)

    def ticker(self, name: str, period_s: float, action: Callable[[], object]) -> None:
        """Add an action that is called at a fixed rate in a thread of its own, also inline, until the run ends.

        A stop or a failure ends it at once, before the inboxes are empty. The action's optional `close` is called once,
        also after an error. `dropped` of its counters are missed deadlines.
        """
        stats = self.telemetry.add(StageStats(name, is_ticker=True))
        self._tickers[name] = partial(self._tick, stats, round(period_s * NS_PER_S), action)

    def _node(
        self, name: str, work: Any, inputs: tuple[Stream[Any], ...], policy: Policy, depth: int, thread: str
    ) -> Stream[Any]:
        thread = thread or name
        node = Node(self, self.telemetry.add(StageStats(name)), work, len(inputs), thread)
        for stream in inputs:
            if not self._threaded or stream.thread == thread:
                stream.readers.append(node.put)
                continue
            inbox = self._inboxes.setdefault(thread, _Inbox(self))
            inbox.nodes.add(node)
            link = _Link(node, stream.depth, NEWEST) if stream.depth else _Link(node, depth, policy)
            stream.readers.append(partial(inbox.put, link))
        return node.stream

    # The run.

    def run(self) -> None:
        """Run until all sources have ended and all threads have joined; only once.

        Raises the first error of any stage with later ones in its notes, and KeyboardInterrupt after a second stop.
        """
        # 1. A thread for each source, each group of stages, and each ticker.
        bodies = self._readers | {name: inbox.serve for name, inbox in self._inboxes.items()}
        work = [self._thread(name, body) for name, body in bodies.items()] if self._threaded else []
        ticks = [self._thread(name, body) for name, body in self._tickers.items()]
        # 2. Run, and wait for the end of all.
        try:
            for thread in ticks + work:
                thread.start()
            if not self._threaded:
                for read in self._readers.values():
                    read()
            self._join(work)
        except BaseException as error:  # from the caller's signal handler, or no thread could be started
            self._errors.insert(0, error)
            self._stops.extend((None, None))
            self._join(work)
        finally:
            self._no_ticks.set()
            for thread in ticks:
                if thread.ident is not None:
                    thread.join()
        # 3. What went wrong.
        for later in self._errors[1:]:
            self._errors[0].add_note(f"and then: {later!r}")
        if self._errors:
            raise self._errors[0]
        if self.aborting:
            raise KeyboardInterrupt("stopped twice: messages that were still in the inboxes are lost")

    def stop(self) -> None:
        """End the sources and process what is in the inboxes; a second call drops the inboxes and finishes nothing.

        Takes no lock, so any thread or signal handler may call it.
        """
        self._stops.append(None)

    def settle(self) -> None:
        """Wait until all messages have been processed, or the run ends: for a source whose time is stopped meanwhile.

        Inline, nothing ever waits.
        """
        with self._idle:
            while not self.is_stopping and not self._idle.wait_for(lambda: not self.waiting, POLL_S):
                pass

    def done(self) -> None:
        """Count a message that was in an inbox as processed."""
        with self._idle:
            self.waiting -= 1
            if not self.waiting:
                self._idle.notify_all()

    @property
    def aborting(self) -> bool:
        """True after a second stop: nothing is finished."""
        return len(self._stops) > 1

    @property
    def is_stopping(self) -> bool:
        """True after a stop or a failure."""
        return bool(self._stops or self._errors)

    @contextmanager
    def watched(self, name: str) -> Iterator[None]:
        """End the run by an error in this block of a stage, which counts as failed."""
        try:
            yield
        except BaseException as error:
            error.add_note(f"in '{name}'")
            self.failed.add(name)
            self._errors.append(error)

    def _thread(self, name: str, body: Callable[[], object]) -> threading.Thread:
        def run() -> None:
            self._on_thread(name)
            body()

        return threading.Thread(target=run, name=name)

    def _read(self, stats: StageStats, given: Callable[[], Iterable[object]], stream: Stream[Any]) -> None:
        """Pass on the messages of a source; then its stream ends, and with the last one the inlets."""
        messages = iter(tuple[object]())
        with self.watched(stats.name):
            try:
                if not self.is_stopping:
                    start_ns, messages = time.perf_counter_ns(), iter(given())
                    for message in messages:
                        stats.add(start_ns)
                        stream.push(message)
                        if self.is_stopping:
                            break
                        start_ns = time.perf_counter_ns()
            finally:
                getattr(messages, "close", nothing)()
        stream.push(END)
        with self.lock:
            self._open_sources -= 1
            is_last = not self._open_sources
        for inlet in self._inlets if is_last else ():
            inlet.push(END)

    def _tick(self, stats: StageStats, period_ns: int, action: Callable[[], object]) -> None:
        """Call an action at its rate until the end; then close it.

        Of several deadlines that have passed the newest is served, without drift and burst.
        """
        deadline_ns = time.monotonic_ns()
        while not self._no_ticks.wait(max(0.0, (deadline_ns - time.monotonic_ns()) * S_PER_NS)):
            if self.is_stopping:
                break
            skipped = max(0, time.monotonic_ns() - deadline_ns) // period_ns
            deadline_ns += (1 + skipped) * period_ns
            stats.dropped += skipped
            with self.watched(stats.name):
                stats.timed(action)
        with self.watched(stats.name):
            getattr(action, "close", nothing)()

    def _join(self, threads: list[threading.Thread]) -> None:
        """Wait for the threads that were started; pass a stop or a failure on to tickers and sources."""
        for thread in threads:
            while thread.is_alive():
                thread.join(POLL_S)
                if self.is_stopping:
                    self._no_ticks.set()
                    while self._wakes:
                        name, wake = self._wakes.popitem()
                        with self.watched(name):
                            wake()
