"""Elements of a graph: stages, sinks, and the streams between them."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Final, Generic, Protocol, TypeAlias, TypeVar

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


# A stage or a sink without a state, and without results at the end, is a function.
Step: TypeAlias = Stage[In_contra, Out_co] | Callable[[In_contra], Out_co | None]
End: TypeAlias = Sink[In_contra] | Callable[[In_contra], None]


class Stream(Generic[T_co]):
    """Output of a source or a stage, with any number of readers, which get each message in the order of the wiring."""

    def __init__(self, thread: str, depth: int = 0) -> None:
        """thread: name of that in which the messages are pushed; empty: any. depth: see Graph.inlet; 0: of a stage."""
        self.thread, self.depth = thread, depth
        self._readers: list[tuple[Callable[[object], None], Callable[[], None]]] = []

    def add(self, put: Callable[[object], None], end: Callable[[], None]) -> None:
        """Add a reader. put: takes a message. end: takes the end of the stream."""
        self._readers.append((put, end))

    def push(self, message: object) -> None:
        """Pass the message to every reader."""
        for put, _ in self._readers:
            put(message)

    def end(self) -> None:
        """Pass the end of the stream to every reader."""
        for _, end in self._readers:
            end()


def nothing(*_: object) -> None:
    """Do nothing: used in place of a method that a stage does not have."""
