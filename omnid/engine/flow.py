"""Elements of a graph, without threads: stages, sinks, sources, the streams between them, the newest-wins slot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from enum import Enum
from typing import Any, Final, Generic, Protocol, TypeVar

from omnid.engine.telemetry import StageStats

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)
Out_co = TypeVar("Out_co", covariant=True)
In_contra = TypeVar("In_contra", contravariant=True)


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


class Reader(Protocol):
    """Receiving end of a stream."""

    def put(self, message: object) -> None:
        """Take one message."""

    def end(self) -> None:
        """Count one writer less; after the last one comes the end of the stream."""


class Stream(Generic[T_co]):
    """Output of a source or a stage, with any number of readers, which get each message in the order of the wiring."""

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

    def process(self, value: T, /) -> None:
        """Replace the value: one atomic reference store."""
        self._value = value

    def get(self) -> T | None:
        """Return the newest value; None before the first."""
        return self._value


def nothing(*_: object) -> None:
    """Do nothing: used in place of a method that a stage does not have."""


class Node:
    """A stage or a sink with its counters and its output stream."""

    def __init__(self, stats: StageStats, work: object) -> None:
        self.stats = stats
        self.stream: Stream[Any] = Stream()
        self._process: Callable[[object], object | None] = getattr(work, "process", nothing)
        self._finish: Callable[[], Iterable[object] | None] = getattr(work, "finish", nothing)

    def handle(self, message: object) -> None:
        """Process the message, and pass its result on."""
        result = self.stats.timed(self._process, message)
        if result is not None:
            self.stream.push(result)

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
            self._alive = self._succeeds(self._node.stats.name, self._node.handle, message)
        else:
            self._node.stats.dropped += 1

    def end(self) -> None:
        """Count one writer less; the last one finishes the node and ends its stream."""
        self._writers -= 1
        if self._writers == 0:
            if self._alive:
                self._succeeds(self._node.stats.name, self._finish, self._node)
            self._node.stream.end()


class Source:
    """Input of the graph: messages of an iterable."""

    def __init__(self, stats: StageStats, messages: Callable[[], Iterable[object]], wake: Callable[[], None]) -> None:
        self.stats, self.wake, self._open = stats, wake, messages
        self.ended = False
        self.stream: Stream[Any] = Stream()
        self._messages: Iterator[object] | None = None

    def step(self) -> None:
        """Pass on the next message, or set `ended`."""
        if self._messages is None:
            self._messages = iter(self._open())
        try:
            message = self.stats.timed(next, self._messages)
        except StopIteration:
            self.ended = True
        else:
            self.stream.push(message)

    def close(self) -> None:
        """Close the iterable if it can be closed (a generator's `finally` runs here)."""
        getattr(self._messages, "close", nothing)()
