"""The graph of stages and its threads: inboxes, tickers, the end of a run. Few other modules import threading.

A stream exists before it is read, so a cycle cannot be wired. Messages flow through bounded inboxes that belong to
their readers; the end of a stream flows the same way. Inline, the same stages run in the caller's thread, each message
depth first, with the same results. With several sources, or where streams merge, only the inline order is fixed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from omnid.engine.flow import (
    LOSSLESS,
    NEWEST,
    Node,
    Policy,
    Sink,
    Slot,
    Source,
    Stage,
    Stream,
    nothing,
)
from omnid.engine.telemetry import StageStats, Telemetry
from omnid.errors import OmnidError

__all__ = ["LOSSLESS", "NEWEST", "Graph", "Policy", "Sink", "Slot", "Stage", "Stream", "Ticker"]

T = TypeVar("T")
In = TypeVar("In")
Out = TypeVar("Out")
_POLL_S: Final = 0.1  # a signal handled in another thread does not wake the main one, so it polls
_END: Final = object()  # what an inbox gives after the last message


class InFlight:
    """Counts the messages that wait in the inboxes of a graph, or are being processed."""

    def __init__(self) -> None:
        self._count = 0
        self._changed = threading.Condition()

    def add(self, count: int) -> None:
        """Add to the number of messages; a negative count: they are done or dropped."""
        with self._changed:
            self._count += count
            if not self._count:
                self._changed.notify_all()

    def is_none(self, timeout_s: float) -> bool:
        """True as soon as there is none; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._count, timeout_s)


class Inbox:
    """Bounded queue in front of a stage's thread; it ends when all its writers have ended.

    Up to `depth` messages of each writer wait. With the policy NEWEST a writer drops its own oldest message: so none
    of two cameras takes the place of the other one's image.
    """

    def __init__(self, stats: StageStats, writers: int, depth: int, policy: Policy, in_flight: InFlight) -> None:
        """in_flight: the count of the graph, in which a message is until its reader asks for the next one."""
        self._stats, self._writers, self._depth, self._policy = stats, writers, depth, policy
        self._in_flight, self._is_processing = in_flight, False
        self._messages: deque[tuple[int, object]] = deque()  # with the number of the writer
        self._changed = threading.Condition()
        self._closed = False

    def put(self, writer: int, message: object) -> None:
        """Add a message of a writer."""
        with self._changed:
            own = [entry for entry in self._messages if entry[0] == writer]
            if self._policy is LOSSLESS:
                self._changed.wait_for(lambda: self._closed or len(self._messages) < self._depth * self._writers)
            elif len(own) >= self._depth:
                self._messages.remove(own[0])
                self._in_flight.add(-1)
                self._stats.dropped += 1
            if self._closed:  # the reader has ended
                self._stats.dropped += 1
                return
            self._messages.append((writer, message))
            self._in_flight.add(1)
            self._stats.busy_since_ns = self._stats.busy_since_ns or time.monotonic_ns()
            self._changed.notify_all()

    def get(self) -> object:
        """Return the next message, _END after the last one; wait for it. The message before is done."""
        if self._is_processing:
            self._in_flight.add(-1)
        with self._changed:
            self._stats.busy_since_ns = time.monotonic_ns() if self._messages else 0
            self._changed.wait_for(lambda: self._messages or not self._writers or self._closed)
            self._is_processing = bool(self._messages)
            if not self._messages:
                return _END
            self._changed.notify_all()
            return self._messages.popleft()[1]

    def end(self) -> None:
        """Count one writer less."""
        with self._changed:
            self._writers -= 1
            self._changed.notify_all()

    def close(self) -> None:
        """Drop and count all messages, those to come too: the reader has ended."""
        with self._changed:
            self._closed = True
            self._stats.dropped += len(self._messages)
            self._in_flight.add(-len(self._messages))
            self._messages.clear()
            self._stats.busy_since_ns = 0
            self._changed.notify_all()


class Ticker:
    """Calls an action at a fixed rate, independent of the stages.

    The graph calls the action's optional `close` once, also after an error. `stats.dropped` counts missed deadlines: of
    those that have passed, the newest is served, without drift and burst.
    """

    def __init__(self, name: str, period_s: float, action: Callable[[], object]) -> None:
        if not 0.0 < period_s < threading.TIMEOUT_MAX:
            raise OmnidError(f"ticker '{name}': expected a period above 0 s, found {period_s}")
        self.stats = StageStats(name, is_ticker=True)
        self._period_ns = round(period_s * 1e9)
        self._action = action
        self._halt = threading.Event()

    def halt(self) -> None:
        """End `run` before its next tick."""
        self._halt.set()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Tick until halted or stopping."""
        deadline_ns = time.monotonic_ns()
        while not self._halt.wait(max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9)) and not stopping():
            now_ns = time.monotonic_ns()
            skipped = max(0, now_ns - deadline_ns) // self._period_ns
            self.stats.dropped += skipped
            self.stats.busy_since_ns = now_ns
            self.stats.timed(self._action)
            self.stats.busy_since_ns = 0
            deadline_ns += (1 + skipped) * self._period_ns

    def close(self) -> None:
        """Close the action."""
        getattr(self._action, "close", nothing)()


class Graph:
    """The wiring of one run, and the run itself.

    `policy` is that of all inboxes unless a sink has its own; `depth` is the capacity of an inbox.
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
        self._in_flight = InFlight()
        self._sources: list[Source] = []
        self._inboxes: list[Inbox] = []
        self._tickers: list[Ticker] = []
        self._threads: list[threading.Thread] = []
        self._ended: list[str] = []  # names of threads
        self._errors: list[BaseException] = []
        self._stops: deque[None] = deque(maxlen=2)
        self._wakeup: SimpleQueue[None] = SimpleQueue()  # its put is reentrant, so safe in a signal handler
        self._ran = False

    def source(
        self, name: str, messages: Callable[[], Iterable[T]], *, wake: Callable[[], None] = nothing
    ) -> Stream[T]:
        """Add a source: an iterable that is opened, read and closed in the source's own thread.

        `wake` is called once to end a threaded run early: it must end the current read and all later ones.
        """
        source = Source(self._add(StageStats(name)), messages, wake)
        self._sources.append(source)
        self._thread(name, self._run_source, source)
        return source.stream

    def stage(self, name: str, stage: Stage[In, Out], *inputs: Stream[In], direct: bool = False) -> Stream[Out]:
        """Add a stage, whose inputs merge into its one inbox; return its output.

        direct: it has no inbox and no thread, and runs in that of the stage before it.
        """
        return self._node(name, stage, inputs, self.policy, self._depth, direct)

    def sink(
        self,
        name: str,
        sink: Sink[In],
        *inputs: Stream[In],
        policy: Policy | None = None,
        depth: int | None = None,
        direct: bool = False,
    ) -> None:
        """Add a sink, with its own policy or depth if given.

        direct: see `stage`; for work of microseconds, since to wake a thread takes longer.
        """
        own = None if self._sinks_wait else policy
        self._node(name, sink, inputs, own or self.policy, self._depth if depth is None else depth, direct)

    def ticker(self, name: str, period_s: float, action: Callable[[], object]) -> Ticker:
        """Add an action that is called at a fixed rate in its own thread, also inline, until the run ends.

        A stop or a failure ends it at once, before the inboxes are empty.
        """
        ticker = Ticker(name, period_s, action)
        self._add(ticker.stats)
        self._tickers.append(ticker)
        return ticker

    def settle(self) -> None:
        """Wait until all messages have been processed, or the run ends: for a source whose time is stopped meanwhile.

        Inline, nothing ever waits.
        """
        while not (self._in_flight.is_none(_POLL_S) or self._stopping):
            pass

    def stop(self) -> None:
        """End the sources and process what is in the inboxes; a second call drops the inboxes and finishes nothing.

        Takes no lock, so any thread or signal handler may call it.
        """
        self._stops.append(None)
        self._wakeup.put(None)

    def run(self) -> None:
        """Run until all sources have ended and all threads have joined; only once.

        Raises the first error of any stage with later ones in its notes, and KeyboardInterrupt after a second stop.
        """
        self._require_fresh()
        self._ran = True
        tickers = [
            threading.Thread(target=self._run_ticker, args=(each,), name=each.stats.name) for each in self._tickers
        ]
        try:
            for thread in tickers + self._threads:
                thread.start()
            self._wait() if self._threaded else self._run_inline()
        except BaseException as error:  # from the caller's signal handler, or no thread could be started
            self._errors.insert(0, error)
            self._stops.extend((None, None))
            self._wait()
        finally:
            for ticker in self._tickers:
                ticker.halt()
            for thread in tickers:
                if thread.ident is not None:
                    thread.join()
        for later in self._errors[1:]:
            self._errors[0].add_note(f"and then: {later!r}")
        if self._errors:
            raise self._errors[0]
        if self._aborting:
            raise KeyboardInterrupt("stopped twice: messages that were still in the inboxes are lost")

    @property
    def _stopping(self) -> bool:
        return bool(self._stops or self._errors)

    @property
    def _aborting(self) -> bool:
        return len(self._stops) > 1

    def _require_fresh(self) -> None:
        if self._ran:
            raise OmnidError("a graph runs once, and is wired before it runs: create a new one")

    def _add(self, stats: StageStats) -> StageStats:
        self._require_fresh()
        return self.telemetry.add(stats)

    def _node(
        self, name: str, work: object, inputs: tuple[Stream[Any], ...], policy: Policy, depth: int, direct: bool
    ) -> Stream[Any]:
        if not inputs or depth < 1:
            raise OmnidError(f"'{name}': expected inputs and a depth above 0, found {len(inputs)} and {depth}")
        node = Node(self._add(StageStats(name)), work, len(inputs), self._succeeds, lambda: self._aborting)
        if self._threaded and not direct:
            inbox = Inbox(node.stats, len(inputs), depth, policy, self._in_flight)
            self._inboxes.append(inbox)
            self._thread(name, self._run_node, node, inbox)
            for writer, stream in enumerate(inputs):
                stream.add(partial(inbox.put, writer), inbox.end)
        else:
            for stream in inputs:
                stream.add(node.put, node.end)
        return node.stream

    def _thread(self, name: str, body: Callable[..., None], *args: object) -> None:
        def run() -> None:
            self._on_thread(name)
            body(*args)
            self._ended.append(name)
            self._wakeup.put(None)

        if self._threaded:
            self._threads.append(threading.Thread(target=run, name=name))

    def _succeeds(self, name: str, work: Callable[..., object], *args: object) -> bool:
        """True if the work raised no error; an error ends the run."""
        try:
            work(*args)
        except BaseException as error:
            error.add_note(f"in '{name}'")
            self._errors.append(error)
            self._wakeup.put(None)
            return False
        return True

    def _run_source(self, source: Source) -> None:
        while self._advances(source):
            pass

    def _advances(self, source: Source) -> bool:
        """True if the source took a step; otherwise it is closed and its stream ends."""
        name = source.stats.name
        if not self._stopping and self._succeeds(name, source.step) and not source.ended:
            return True
        self._succeeds(name, source.close)
        source.stream.end()
        return False

    def _run_node(self, node: Node, inbox: Inbox) -> None:
        while node.alive and (message := inbox.get()) is not _END:
            node.put(message)
        inbox.close()
        node.close()

    def _run_inline(self) -> None:
        active = deque(self._sources)
        while active:  # round robin
            source = active.popleft()
            if self._advances(source):
                active.append(source)

    def _run_ticker(self, ticker: Ticker) -> None:
        name = ticker.stats.name
        self._on_thread(name)
        self._succeeds(name, ticker.run, lambda: self._stopping)
        self._succeeds(name, ticker.close)

    def _wait(self) -> None:
        """Wait for the threads that were started; pass a stop or a failure on to sources, tickers and inboxes."""
        started = [thread for thread in self._threads if thread.ident is not None]
        while len(self._ended) < len(started):
            with suppress(Empty):
                self._wakeup.get(timeout=_POLL_S)
            if self._stopping:
                for ticker in self._tickers:
                    ticker.halt()
                for source in self._sources:
                    wake, source.wake = source.wake, nothing
                    self._succeeds(source.stats.name, wake)
            if self._aborting:
                for inbox in self._inboxes:
                    inbox.close()
        for thread in started:
            thread.join()
