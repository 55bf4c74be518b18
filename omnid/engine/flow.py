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


class Stream(Generic[T_co]):
    """Output of a source or a stage, with any number of readers, which get each message in the order of the wiring."""

    def __init__(self) -> None:
        self._readers: list[tuple[Callable[[object], None], Callable[[], None]]] = []

    def add(self, put: Callable[[object], None], end: Callable[[], None]) -> None:
        """Add a reader. put: takes a message. end: counts one writer less."""
        self._readers.append((put, end))

    def push(self, message: object) -> None:
        """Pass the message to every reader."""
        for put, _ in self._readers:
            put(message)

    def end(self) -> None:
        """Pass the end of the stream to every reader."""
        for _, end in self._readers:
            end()


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
    """A stage or a sink with its counters and its output stream; after an error it takes no more messages."""

    def __init__(
        self,
        stats: StageStats,
        work: object,
        writers: int,
        succeeds: Callable[..., bool],
        is_aborting: Callable[[], bool],
    ) -> None:
        """writers: number of streams that it reads. succeeds: calls its second argument with the others; True where
        that raised no error; the first one is the name of the stage. is_aborting: True where nothing is finished.
        """
        self.stats, self._writers = stats, writers
        self._succeeds, self._is_aborting = succeeds, is_aborting
        self.stream: Stream[Any] = Stream()
        self.alive = True
        self._process: Callable[[object], object | None] = getattr(work, "process", nothing)
        self._finish: Callable[[], Iterable[object] | None] = getattr(work, "finish", nothing)

    def put(self, message: object) -> None:
        """Process the message, and pass its result on; after an error it is counted as dropped."""
        if self.alive:
            self.alive = self._succeeds(self.stats.name, self._handle, message)
        else:
            self.stats.dropped += 1

    def end(self) -> None:
        """Count one writer less; after the last one the results that remain are passed on, and the stream ends."""
        self._writers -= 1
        if self._writers == 0:
            self.close()

    def close(self) -> None:
        """End the stream, after the results that remain."""
        if self.alive and not self._is_aborting():
            self._succeeds(self.stats.name, self._pass_on_rest)
        self.stream.end()

    def _handle(self, message: object) -> None:
        result = self.stats.timed(self._process, message)
        if result is not None:
            self.stream.push(result)

    def _pass_on_rest(self) -> None:
        for result in self._finish() or ():
            self.stream.push(result)


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
