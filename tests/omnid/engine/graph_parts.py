"""Sinks and stages for the tests of the graph."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import pytest

from omnid.engine.graph import Graph

LONG_S = 20.0  # a timeout that only a defect reaches


both = pytest.mark.parametrize("threaded", [True, False], ids=["threaded", "inline"])


@dataclass
class Collect:
    """A sink that keeps its messages and counts calls of finish."""

    got: list[int] = field(default_factory=list)
    finished: int = 0

    def process(self, message: int) -> None:
        self.got.append(message)

    def finish(self) -> None:
        self.finished += 1


@dataclass
class Apply:
    """A stage without finish."""

    function: Callable[[int], int | None]

    def process(self, message: int) -> int | None:
        return self.function(message)


@dataclass
class Sums:
    """A stage with state: sums of two messages; at the end the message left over and a marker."""

    held: list[int] = field(default_factory=list)

    def process(self, message: int) -> int | None:
        self.held.append(message)
        if len(self.held) < 2:
            return None
        total, self.held = sum(self.held), []
        return total

    def finish(self) -> Iterable[int]:
        yield from self.held
        yield -1


def fail_at(bad: int) -> Callable[[int], int]:
    def check(message: int) -> int:
        if message == bad:
            raise ValueError(f"cannot take {message}")
        return message

    return check


def stopped_at(graph: Graph, last: int, act: Callable[[], None]) -> Callable[[int], int]:
    """Return a function that passes messages on and acts at one of them."""

    def check(message: int) -> int:
        if message == last:
            act()
        return message

    return check


@dataclass
class Action:
    """An action that sets an event at the call `enough` and fails at the call `bad`."""

    enough: int
    bad: int = -1
    calls: int = 0
    closed: int = 0
    reached: threading.Event = field(default_factory=threading.Event)

    def __call__(self) -> None:
        self.calls += 1
        if self.calls == self.bad:
            raise OSError("no answer from the motor")
        if self.calls >= self.enough:
            self.reached.set()

    def close(self) -> None:
        self.closed += 1
