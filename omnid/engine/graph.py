"""The graph of stages and its threads: inboxes, tickers, the end of a run. Few other modules import threading.

A stream exists before it is read, so a cycle cannot be wired. A thread has one bounded inbox, from which it serves its
stages in the order of arrival; between stages of one thread messages pass directly. The end of a stream is the last
message of it. Inline, the same stages run in the caller's thread, each message depth first, with the same results.
With several sources, or where streams merge, only the inline order is fixed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

from omnid.core.nanoseconds import NS_PER_S, S_PER_NS
from omnid.engine.telemetry import StageStats, Telemetry

T = TypeVar("T")
In = TypeVar("In")
Out = TypeVar("Out")
T_co = TypeVar("T_co", covariant=True)
Out_co = TypeVar("Out_co", covariant=True)
In_contra = TypeVar("In_contra", contravariant=True)
TICKS: Final = "ticks"  # the thread of the tickers that name no other
POLL_S: Final = 0.1  # a signal handled in another thread does not wake the main one, so it polls
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
        if message is END:
            self.writers -= 1
            if self.writers:
                return
            if name not in graph.failed and not graph.aborting:
                with graph.watched(name):
                    for result in self._finish() or ():
                        self.stream.push(result)
            self.stream.push(END)
        elif not self.writers or name in graph.failed:
            self.stats.dropped += 1
        else:
            with graph.watched(name):
                result = self.stats.timed(self._process, message)
                if result is not None:
                    self.stream.push(result)


@dataclass(slots=True, eq=False)
class Link:
    """One of the streams that a node reads, with the bound of what may wait of it."""

    node: Node
    depth: int
    policy: Policy
    waiting: int = 0


class Inbox:
    """Bounded queue in front of a thread, from which it serves its nodes.

    With the policy NEWEST a stream drops its own oldest message, so none of two cameras takes the place of the other
    one's image.
    """

    def __init__(self, lock: threading.Lock, idle: threading.Condition) -> None:
        """lock: of all inboxes of the graph. idle: notified when the reader has done all that waited."""
        self.nodes: list[Node] = []
        self._changed, self._idle = threading.Condition(lock), idle
        self._messages: deque[tuple[Link, object]] = deque()
        self._is_busy = self._is_closed = False

    @property
    def is_idle(self) -> bool:
        """True if no message waits or is being processed; to be asked under the lock."""
        return not self._messages and not self._is_busy

    def put(self, link: Link, message: object) -> None:
        """Add a message of a stream; the end of one always has room."""
        stats = link.node.stats
        with self._changed:
            if message is not END:
                if link.policy is LOSSLESS:
                    self._changed.wait_for(lambda: self._is_closed or link.waiting < link.depth)
                elif link.waiting >= link.depth:
                    del self._messages[next(k for k, (other, _) in enumerate(self._messages) if other is link)]
                    link.waiting -= 1
                    stats.dropped += 1
                if self._is_closed:
                    stats.dropped += 1
                    return
                link.waiting += 1
                stats.busy_since_ns = stats.busy_since_ns or time.monotonic_ns()
            self._messages.append((link, message))
            self._changed.notify_all()

    def serve(self) -> None:
        """Pass the messages to their nodes until all streams of these have ended."""
        while any(node.writers for node in self.nodes):
            # 1. The next message.
            with self._changed:
                self._changed.wait_for(lambda: self._messages)
                link, message = self._messages.popleft()
                self._is_busy = True
                link.waiting -= message is not END
                self._changed.notify_all()
            # 2. Its node does the work.
            link.node.put(message)
            # 3. It is done.
            with self._changed:
                self._is_busy = False
                waits = any(other.node is link.node for other, _ in self._messages)
                link.node.stats.busy_since_ns = time.monotonic_ns() if waits else 0
                if not self._messages:
                    self._idle.notify_all()

    def close(self) -> None:
        """Drop and count all messages, those to come too; the ends of streams stay."""
        with self._changed:
            self._is_closed = True
            for link, message in self._messages:
                link.node.stats.dropped += message is not END
                link.waiting = 0
            self._messages = deque(each for each in self._messages if each[1] is END)
            self._changed.notify_all()


@dataclass(slots=True, eq=False)
class _Source:
    """Input of the graph: messages of an iterable."""

    stats: StageStats
    open: Callable[[], Iterable[object]]
    wake: Callable[[], None]
    stream: Stream[Any]


@dataclass(slots=True, eq=False)
class _Ticker:
    """An action at a fixed rate. `stats.dropped` counts missed deadlines."""

    stats: StageStats
    period_ns: int
    action: Callable[[], object]
    deadline_ns: int = 0


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
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._sources: list[_Source] = []
        self._inlets: list[Stream[Any]] = []
        self._inboxes: dict[str, Inbox] = {}  # by thread
        self._tickers: dict[str, list[_Ticker]] = {}  # by thread
        self._ended: set[str] = set()  # names of threads
        self.failed: set[str] = set()  # names of stages
        self._errors: list[BaseException] = []
        self._stops: deque[None] = deque(maxlen=2)
        self._wakeup: SimpleQueue[None] = SimpleQueue()  # its put is reentrant, so safe in a signal handler
        self._no_ticks = threading.Event()
        self._open_sources = 0

    # The wiring.

    def source(
        self, name: str, messages: Callable[[], Iterable[T]], *, wake: Callable[[], None] = nothing
    ) -> Stream[T]:
        """Add a source: an iterable that is opened, read and closed in the source's own thread.

        `wake` is called once to end a threaded run early: it must end the current read and all later ones.
        """
        stream: Stream[T] = Stream(name)
        self._sources.append(_Source(self.telemetry.add(StageStats(name)), messages, wake, stream))
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

    def ticker(self, name: str, period_s: float, action: Callable[[], object], thread: str = TICKS) -> None:
        """Add an action that is called at a fixed rate, also inline, until the run ends; tickers share a thread.

        A stop or a failure ends it at once, before the inboxes are empty. The action's optional `close` is called once,
        also after an error.
        """
        ticker = _Ticker(self.telemetry.add(StageStats(name, is_ticker=True)), round(period_s * NS_PER_S), action)
        self._tickers.setdefault(thread, []).append(ticker)

    def _node(
        self, name: str, work: Any, inputs: tuple[Stream[Any], ...], policy: Policy, depth: int, thread: str
    ) -> Stream[Any]:
        thread = thread or name
        node = Node(self, self.telemetry.add(StageStats(name)), work, len(inputs), thread)
        for stream in inputs:
            if not self._threaded or stream.thread == thread:
                stream.readers.append(node.put)
                continue
            inbox = self._inboxes.setdefault(thread, Inbox(self._lock, self._idle))
            if node not in inbox.nodes:
                inbox.nodes.append(node)
            link = Link(node, stream.depth, NEWEST) if stream.depth else Link(node, depth, policy)
            stream.readers.append(partial(inbox.put, link))
        return node.stream

    # The run.

    def run(self) -> None:
        """Run until all sources have ended and all threads have joined; only once.

        Raises the first error of any stage with later ones in its notes, and KeyboardInterrupt after a second stop.
        """
        # 1. A thread for each source, each group of stages, and each group of tickers.
        bodies: dict[str, Callable[[], object]] = {
            source.stats.name: partial(deque, self._steps(source), 0) for source in self._sources
        }
        bodies |= {name: inbox.serve for name, inbox in self._inboxes.items()}
        work = [self._thread(name, body) for name, body in bodies.items()] if self._threaded else []
        ticks = [self._thread(name, partial(self._tick, group)) for name, group in self._tickers.items()]
        # 2. Run, and wait for the end of all.
        try:
            for thread in ticks + work:
                thread.start()
            self._wait(work) if self._threaded else self._run_inline()
        except BaseException as error:  # from the caller's signal handler, or no thread could be started
            self._errors.insert(0, error)
            self._stops.extend((None, None))
            self._wait(work)
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
        self._wakeup.put(None)

    def settle(self) -> None:
        """Wait until all messages have been processed, or the run ends: for a source whose time is stopped meanwhile.

        Inline, nothing ever waits.
        """
        with self._idle:
            while not self.is_stopping:
                if self._idle.wait_for(lambda: all(inbox.is_idle for inbox in self._inboxes.values()), POLL_S):
                    return

    @property
    def aborting(self) -> bool:
        """True after a second stop: nothing is finished."""
        return len(self._stops) > 1

    @contextmanager
    def watched(self, name: str) -> Iterator[None]:
        """End the run by an error in this block of a stage, which counts as failed."""
        try:
            yield
        except GeneratorExit:  # of a source that is given up
            raise
        except BaseException as error:
            error.add_note(f"in '{name}'")
            self.failed.add(name)
            self._errors.append(error)
            self._wakeup.put(None)

    @property
    def is_stopping(self) -> bool:
        """True after a stop or a failure."""
        return bool(self._stops or self._errors)

    def _thread(self, name: str, body: Callable[[], object]) -> threading.Thread:
        def run() -> None:
            self._on_thread(name)
            body()
            self._ended.add(name)
            self._wakeup.put(None)

        return threading.Thread(target=run, name=name)

    def _steps(self, source: _Source) -> Iterator[None]:
        """Pass on the messages of a source, one a step; then its stream ends, with the last one the inlets."""
        stats, messages = source.stats, iter(tuple[object]())
        with self.watched(stats.name):
            try:
                if not self.is_stopping:
                    start_ns, messages = time.perf_counter_ns(), iter(source.open())
                    for message in messages:
                        stats.add(start_ns)
                        source.stream.push(message)
                        yield
                        if self.is_stopping:
                            break
                        start_ns = time.perf_counter_ns()
            finally:
                getattr(messages, "close", nothing)()
        source.stream.push(END)
        with self._lock:
            self._open_sources -= 1
            is_last = not self._open_sources
        for inlet in self._inlets if is_last else ():
            inlet.push(END)

    def _run_inline(self) -> None:
        active = deque(map(self._steps, self._sources))
        while active:  # round robin
            steps = active.popleft()
            if next(steps, END) is not END:
                active.append(steps)

    def _tick(self, group: list[_Ticker]) -> None:
        """Call the actions of a thread, each at its rate, until the end; then close them.

        Of several deadlines that have passed the newest is served, without drift and burst.
        """
        for ticker in group:
            ticker.deadline_ns = time.monotonic_ns()
        while True:
            ticker = min(group, key=lambda each: each.deadline_ns)
            if self._no_ticks.wait(max(0.0, (ticker.deadline_ns - time.monotonic_ns()) * S_PER_NS)) or self.is_stopping:
                break
            stats, now_ns = ticker.stats, time.monotonic_ns()
            skipped = max(0, now_ns - ticker.deadline_ns) // ticker.period_ns
            ticker.deadline_ns += (1 + skipped) * ticker.period_ns
            stats.dropped += skipped
            stats.busy_since_ns = now_ns
            with self.watched(stats.name):
                stats.timed(ticker.action)
            stats.busy_since_ns = 0
        for ticker in group:
            with self.watched(ticker.stats.name):
                getattr(ticker.action, "close", nothing)()

    def _wait(self, threads: list[threading.Thread]) -> None:
        """Wait for the threads that were started; pass a stop or a failure on to sources, tickers and inboxes."""
        started = [thread for thread in threads if thread.ident is not None]
        while not self._ended.issuperset(thread.name for thread in started):
            with suppress(Empty):
                self._wakeup.get(timeout=POLL_S)
            if self.is_stopping:
                self._no_ticks.set()
                for source in self._sources:
                    wake, source.wake = source.wake, nothing
                    with self.watched(source.stats.name):
                        wake()
            if self.aborting:
                for inbox in self._inboxes.values():
                    inbox.close()
        for thread in started:
            thread.join()
