"""Elements of a graph, without threads: stages, sinks, sources, the streams between them, the newest-wins slot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from typing import Any, Final, Generic, Protocol, TypeVar

from omnid.engine.telemetry import StageStats, Stopwatch

T = TypeVar("T")
In = TypeVar("In")
Mid = TypeVar("Mid")
Out = TypeVar("Out")
T_co = TypeVar("T_co", covariant=True)
Out_co = TypeVar("Out_co", covariant=True)
In_contra = TypeVar("In_contra", contravariant=True)


class Policy(Enum):
    """Policy of a full inbox: LOSSLESS lets the writer wait, NEWEST drops the oldest message and counts it."""

    LOSSLESS = "lossless"
    NEWEST = "newest"


LOSSLESS: Final = Policy.LOSSLESS
NEWEST: Final = Policy.NEWEST
END: Final = object()


class Stage(Protocol[In_contra, Out_co]):
    """A step of the flow; may also have `finish() -> Iterable[Out]` for the results left at the end.

    And `after() -> None`, called after the result of each message was passed on: for work that no reader waits for.
    And `merge(older: In, newer: In) -> In`, which returns what takes the place of two messages where its inbox drops
    the older one: for a part of a message that must not be lost. It is called in the writer's thread.
    """

    def process(self, message: In_contra, /) -> Out_co | None:
        """Return the result of the message, None without one."""


class Sink(Protocol[In_contra]):
    """An end of the flow; may also have `finish() -> None`."""

    def process(self, message: In_contra, /) -> None:
        """Take a message out of the graph."""


class Reader(Protocol):
    """Receiving end of a stream."""

    def put(self, message: object) -> None:
        """Take one message."""

    def end(self) -> None:
        """Count one writer less; after the last one comes the end of the stream."""


class Stream(Generic[T_co]):
    """Output of a source or a stage, with any number of readers."""

    def __init__(self) -> None:
        self.readers: list[Reader] = []

    def push(self, message: object) -> None:
        """Pass the message to every reader."""
        for reader in self.readers:
            reader.put(message)

    def end(self) -> None:
        """Pass the end of the stream to every reader."""
        for reader in self.readers:
            reader.end()


class Slot(Generic[T]):
    """Holds the newest value for a reader that never waits; also a sink."""

    def __init__(self) -> None:
        self._value: T | None = None

    def put(self, value: T, /) -> None:
        """Replace the value: one atomic reference store, safe in a signal handler."""
        self._value = value

    process = put

    def get(self) -> T | None:
        """Return the newest value; None before the first."""
        return self._value


def nothing(*_: object) -> None:
    """Do nothing: used in place of a method that a stage does not have."""


def newest(_: object, newer: object) -> object:
    """Return the newer one of two messages: used in place of the `merge` that a stage does not have."""
    return newer


class Node:
    """A stage or a sink with its counters and its output stream."""

    def __init__(self, stats: StageStats, work: object) -> None:
        self.name = stats.name
        self.stats = stats
        self.stream: Stream[Any] = Stream()
        self._process: Callable[[object], object | None] = getattr(work, "process", nothing)
        self._after: Callable[[], object] = getattr(work, "after", nothing)
        self._finish: Callable[[], Iterable[object] | None] = getattr(work, "finish", nothing)
        self.merge: Callable[[Any, Any], object] = getattr(work, "merge", newest)

    def handle(self, message: object, passed_on: Callable[[], object] = nothing) -> None:
        """Process the message, pass its result on, and let the stage do what it has left to do.

        passed_on: called between the last two.
        """
        watch = Stopwatch()
        result = self._process(message)
        if result is not None:
            watch.pause()
            self.stream.push(result)
            watch.resume()
        passed_on()
        self._after()
        self.stats.count(watch)

    def finish(self) -> None:
        """Pass on the results that remain at the end of the stream."""
        for result in self._finish() or ():
            self.stream.push(result)


class Direct:
    """Inline reader: the work happens within the writer's call.

    `succeeds(name, work, *args)` does the work and is True if no error was raised; `finish(node)` finishes the node.
    """

    def __init__(self, node: Node, writers: int, succeeds: Callable[..., bool], finish: Callable[[Node], None]) -> None:
        self._node, self._writers, self._succeeds, self._finish = node, writers, succeeds, finish
        self._alive = True

    def put(self, message: object) -> None:
        """Handle the message; after a failure of the node it is counted as dropped instead."""
        if self._alive:
            self._alive = self._succeeds(self._node.name, self._node.handle, message)
        else:
            self._node.stats.dropped += 1

    def end(self) -> None:
        """Count one writer less; the last one finishes the node and ends its stream."""
        self._writers -= 1
        if self._writers == 0:
            if self._alive:
                self._succeeds(self._node.name, self._finish, self._node)
            self._node.stream.end()


class Source:
    """Input of the graph: messages of an iterable."""

    def __init__(self, stats: StageStats, messages: Callable[[], Iterable[object]], wake: Callable[[], None]) -> None:
        self.name = stats.name
        self.wake = wake
        self.ended = False
        self.stream: Stream[Any] = Stream()
        self._stats = stats
        self._open = messages
        self._messages: Iterator[object] | None = None
        self._close: Callable[[], object] = nothing

    def step(self) -> None:
        """Pass on the next message, or set `ended`."""
        if self._messages is None:
            messages = iter(self._open())
            self._close = getattr(messages, "close", nothing)
            self._messages = self._stats.timed_each(messages)
        message = next(self._messages, END)
        if message is END:
            self.ended = True
        else:
            self.stream.push(message)

    def close(self) -> None:
        """Close the iterable if it can be closed (a generator's `finally` runs here)."""
        self._close()
