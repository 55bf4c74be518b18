"""Source and sink of a drive in lock-step: requests that never wait, and a function that takes messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from omnid.core.navigation.requests import NavigationCommand

T = TypeVar("T")


class LockstepRequests:
    """Requests to the navigation, as a source that never waits: each turn yields the requests since the last one."""

    def __init__(self) -> None:
        self._waiting: list[NavigationCommand] = []
        self._ended = False

    def put(self, command: NavigationCommand) -> None:
        """Add a request."""
        self._waiting.append(command)

    def end(self) -> None:
        """End `batches`."""
        self._ended = True

    def batches(self) -> Iterator[list[NavigationCommand]]:
        """Yield the requests of each turn, mostly none."""
        while not self._ended:
            taken, self._waiting = self._waiting, []
            yield taken


class Take(Generic[T]):
    """A sink that calls a function."""

    def __init__(self, take: Callable[[T], None]) -> None:
        self._take = take

    def process(self, message: T, /) -> None:
        """Take a message."""
        self._take(message)
