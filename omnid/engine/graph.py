"""The graph of stages and its threads. Only this module and those of inboxes and tickers import threading.

A stream exists before it is read, so a cycle cannot be wired. Messages flow through bounded inboxes that belong to
their readers; the end of a stream flows the same way. Inline, the same stages run in the caller's thread, each message
depth first, with the same results. With several sources, or where streams merge, only the inline order is fixed.
"""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Any, Final, TypeVar

from omnid.engine.flow import (
    END,
    LOSSLESS,
    NEWEST,
    Direct,
    Node,
    Policy,
    Reader,
    Sink,
    Slot,
    Source,
    Stage,
    Stream,
    nothing,
)
from omnid.engine.inbox import InFlight, Port, StageInbox
from omnid.engine.telemetry import StageStats, Telemetry
from omnid.engine.ticker import Ticker
from omnid.errors import OmnidError

__all__ = ["LOSSLESS", "NEWEST", "Graph", "Policy", "Sink", "Slot", "Stage", "Stream", "Ticker"]

T = TypeVar("T")
In = TypeVar("In")
Out = TypeVar("Out")
_POLL_S: Final = 0.1  # a signal handled in another thread does not wake the main one, so it polls


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
        self.telemetry = Telemetry()
        self._policy, self._threaded, self._depth, self._on_thread = policy, threaded, depth, on_thread
        self._sinks_wait = sinks_wait
        self._in_flight = InFlight()
        self._sources: list[Source] = []
        self._inboxes: dict[str, StageInbox] = {}  # inboxes by the name of the stage
        self._tickers: list[Ticker] = []
        self._threads: list[threading.Thread] = []
        self._ended: set[str] = set()  # names of threads
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

        direct: it has no inbox and no thread, and runs in that of the stage before it, which is its only input.
        """
        node = Node(self._add(StageStats(name)), stage)
        return self._direct(node, *inputs) if direct else self._node(node, inputs, self._policy, self._depth)

    def bound(self, head: str, tail: str) -> None:
        """Let the stage `head` take a message only when `tail`, a stage after it, will soon be able to take the result.

        So at most one message is between both, and under overload the head's inbox drops what is old before
        any work is done for it: the tail gets the newest. Inline, nothing ever waits.
        """
        if self._threaded:
            self._inboxes[head].prepare_for(self._inboxes[tail])

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
        node = Node(self._add(StageStats(name)), sink)
        if direct:
            self._direct(node, *inputs)
            return
        own = None if self._sinks_wait else policy
        self._node(node, inputs, own or self._policy, self._depth if depth is None else depth)

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

        What a stage does after it has passed on its result counts. Inline, nothing ever waits.
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
        """Run until the sources have ended, the inboxes are empty and the threads have joined; only once.

        Ctrl-C calls `stop`. Raises the first error of any stage with later ones in its notes, and KeyboardInterrupt
        after a second stop.
        """
        self._require_fresh()
        self._ran = True
        with self._ctrl_c_stops():
            self._execute()
        for error in self._errors[1:]:
            self._errors[0].add_note(f"and then: {error!r}")
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

    def _direct(self, node: Node, before: Stream[Any]) -> Stream[Any]:
        before.readers.append(Direct(node, 1, self._succeeds, self._finish))
        return node.stream

    def _node(self, node: Node, inputs: tuple[Stream[Any], ...], policy: Policy, depth: int) -> Stream[Any]:
        if not inputs or depth < 1:
            raise OmnidError(f"'{node.name}': expected inputs and a depth above 0, found {len(inputs)} and {depth}")
        readers: list[Reader] = [Direct(node, len(inputs), self._succeeds, self._finish)] * len(inputs)
        if self._threaded:
            inbox = StageInbox(node.stats, len(inputs), depth, policy, self._in_flight, node.merge)
            self._inboxes[node.name] = inbox
            self._thread(node.name, self._run_node, node, inbox)
            readers = [Port(inbox, writer) for writer in range(len(inputs))]
        for stream, reader in zip(inputs, readers, strict=True):
            stream.readers.append(reader)
        return node.stream

    def _thread(self, name: str, body: Callable[..., None], *args: object) -> None:
        def run() -> None:
            self._on_thread(name)
            body(*args)
            self._ended.add(name)
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
        if not (source.ended or self._stopping) and self._succeeds(source.name, source.step):
            return True
        self._succeeds(source.name, source.close)
        source.stream.end()
        return False

    def _run_node(self, node: Node, inbox: StageInbox) -> None:
        self._succeeds(node.name, self._drain, node, inbox)
        inbox.close()
        node.stream.end()

    def _drain(self, node: Node, inbox: StageInbox) -> None:
        while (message := inbox.get()) is not END:
            node.handle(message, inbox.passed_on)
        self._finish(node)

    def _finish(self, node: Node) -> None:
        if not self._aborting:
            node.finish()

    def _run_inline(self) -> None:
        active = deque(self._sources)
        while active:  # round robin
            source = active.popleft()
            if self._advances(source):
                active.append(source)

    def _run_ticker(self, ticker: Ticker) -> None:
        self._on_thread(ticker.name)
        self._succeeds(ticker.name, ticker.run, lambda: self._stopping)
        self._succeeds(ticker.name, ticker.close)

    def _execute(self) -> None:
        ticker_threads = [
            threading.Thread(target=self._run_ticker, args=(ticker,), name=ticker.name) for ticker in self._tickers
        ]
        try:
            for thread in ticker_threads + self._threads:
                thread.start()
            self._wait() if self._threaded else self._run_inline()
        except BaseException as error:  # from the caller's signal handler, or no thread could be started
            self._errors.insert(0, error)
            self._stops.extend((None, None))
            self._wait()
        finally:
            for ticker in self._tickers:
                ticker.halt()
            for thread in filter(_started, ticker_threads):
                thread.join()

    def _wait(self) -> None:
        started = list(filter(_started, self._threads))
        while any(thread.name not in self._ended for thread in started):
            with suppress(Empty):
                self._wakeup.get(timeout=_POLL_S)
            self._pass_on_stop()
        for thread in started:
            thread.join()

    def _pass_on_stop(self) -> None:
        if self._stopping:
            for ticker in self._tickers:
                ticker.halt()
            for source in self._sources:
                wake, source.wake = source.wake, nothing
                self._succeeds(source.name, wake)
        if self._aborting:
            for inbox in self._inboxes.values():
                inbox.close()

    @contextmanager
    def _ctrl_c_stops(self) -> Iterator[None]:
        """Make Ctrl-C a stop: a KeyboardInterrupt could leave a lock or the state of a stage inconsistent."""
        in_main = threading.current_thread() is threading.main_thread()
        if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
            yield
            return
        signal.signal(signal.SIGINT, self._on_ctrl_c)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _on_ctrl_c(self, *_: object) -> None:
        self.stop()
        if self._aborting and not self._threaded:  # nothing else interrupts a stage in the main thread
            raise KeyboardInterrupt


def _started(thread: threading.Thread) -> bool:
    return thread.ident is not None
