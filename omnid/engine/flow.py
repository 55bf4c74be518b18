"""What a graph is made of, threads left out: the boxes, the wires between them and the newest-wins slot."""

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
    """What a full inbox does: LOSSLESS lets the writer wait, NEWEST forgets the oldest message and counts it."""

    LOSSLESS = "lossless"
    NEWEST = "newest"


LOSSLESS: Final = Policy.LOSSLESS
NEWEST: Final = Policy.NEWEST
END: Final = object()


class Stage(Protocol[In_contra, Out_co]):
    """One box of the flow; may also have `finish() -> Iterable[Out]` for what is in hand at the end of the stream."""

    def process(self, message: In_contra, /) -> Out_co | None:
        """What follows from the message, if anything."""


class Sink(Protocol[In_contra]):
    """An end of the flow; may also have `finish() -> None`."""

    def process(self, message: In_contra, /) -> None:
        """Takes the message out of the graph."""


class Reader(Protocol):
    """Where a wire ends."""

    def put(self, message: object) -> None:
        """Takes one message."""

    def end(self) -> None:
        """One writer less; after the last one comes the end."""


class Stream(Generic[T_co]):
    """What a source or a stage gives: a wire with any number of readers."""

    def __init__(self) -> None:
        self.readers: list[Reader] = []

    def push(self, message: object) -> None:
        """Hands the message to every reader."""
        for reader in self.readers:
            reader.put(message)

    def end(self) -> None:
        """Hands the end to every reader."""
        for reader in self.readers:
            reader.end()


class Slot(Generic[T]):
    """The newest value put, for a reader that never waits; also a sink."""

    def __init__(self) -> None:
        self._value: T | None = None

    def put(self, value: T, /) -> None:
        """Replaces the value: one reference store, atomic, so that a signal handler may call it too."""
        self._value = value

    process = put

    def get(self) -> T | None:
        """The newest value; None before the first."""
        return self._value


def nothing(*_: object) -> None:
    """Stands for a method that a box does not have."""


class Node:
    """A stage or a sink with its counters and the stream that leaves it."""

    def __init__(self, stats: StageStats, work: object) -> None:
        self.name = stats.name
        self.stats = stats
        self.stream: Stream[Any] = Stream()
        self._process: Callable[[object], object | None] = getattr(work, "process", nothing)
        self._finish: Callable[[], Iterable[object] | None] = getattr(work, "finish", nothing)

    def handle(self, message: object) -> None:
        """Processes the message and passes on what follows from it."""
        result = self.stats.timed(self._process, message)
        if result is not None:
            self.stream.push(result)

    def finish(self) -> None:
        """Passes on what is still in hand."""
        for result in self._finish() or ():
            self.stream.push(result)


class Direct:
    """The inline reader: the work happens within the writer's call.

    `succeeds(name, work, *args)` does the work and says whether it came to its end; `finish(node)` ends the node.
    """

    def __init__(
        self, node: Node, writers: int, succeeds: Callable[..., bool], finish: Callable[[Node], None]
    ) -> None:
        self._node, self._writers, self._succeeds, self._finish = node, writers, succeeds, finish
        self._alive = True

    def put(self, message: object) -> None:
        """Handles the message, unless the node has failed: then it is counted as dropped."""
        if self._alive:
            self._alive = self._succeeds(self._node.name, self._node.handle, message)
        else:
            self._node.stats.dropped += 1

    def end(self) -> None:
        """One writer less; the last one finishes the node and ends its stream."""
        self._writers -= 1
        if self._writers == 0:
            if self._alive:
                self._succeeds(self._node.name, self._finish, self._node)
            self._node.stream.end()


class Source:
    """A box without an inbox: its messages come from outside."""

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
        """Passes on the next message, or notes the end."""
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
        """Closes the iterable where it can be closed (a generator's `finally` runs here)."""
        self._close()
