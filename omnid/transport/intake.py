"""Intake of the bus from the messages that others send, with a limit for each key, and for each sender on it.

zenoh puts messages into a ring without any Python, where the newest replace the oldest. A thread takes a bounded number
of them, so that no flood takes the time of the stages: with a Python callback, each message would.
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from omnid.transport.topics import PATH, REQUEST_TOPICS

T = TypeVar("T")
MOST_SENDERS: Final = 64  # Most senders on a key that are distinguished.
TAKEN_PER_DECODED: Final = 4  # messages that are taken for one that a sender may have decoded


@dataclass(frozen=True, slots=True)
class Budget:
    """Messages that one sender may have decoded on one key."""

    rate_hz: float
    burst: int  # number at once, and in the ring


STREAM: Final = Budget(1000.0, 1024)  # setpoints, samples of wheels and gyro
REQUEST: Final = Budget(20.0, 64)
LONG_REQUEST: Final = Budget(2.0, 4)  # A request of up to 1 MiB.
UNKNOWN: Final = Budget(200.0, 128)  # topics that do not exist; of up to 1 MiB
QUERY: Final = Budget(50.0, 64)
_BUDGETS: Final = {**dict.fromkeys(REQUEST_TOPICS, REQUEST), PATH: LONG_REQUEST}


def budget_of(topic: str) -> Budget:
    """Return the budget of a topic from `cmd` on."""
    return _BUDGETS.get(topic, STREAM)


class TokenBucket:
    """A budget that is used up by messages and grows with time."""

    def __init__(self, budget: Budget) -> None:
        self._rate_hz, self._burst = budget.rate_hz, float(budget.burst)
        self._tokens, self._at_s = self._burst, 0.0

    def take(self, now_s: float) -> bool:
        """Use a token; return False where there is none."""
        self._tokens = min(self._burst, self._tokens + (now_s - self._at_s) * self._rate_hz)
        self._at_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


class Intake(Generic[T]):
    """Takes messages of one key out of its ring.

    refused: messages that were taken and not passed on, because their sender has used up its budget; what the ring
    loses is not counted one by one. crowded: times at which more were left in the ring than may be taken.
    """

    def __init__(
        self,
        key: str,
        next_message: Callable[[], T | None],
        budget: Budget,
        sender_of: Callable[[T], str] = lambda _: "",
    ) -> None:
        self.key, self._next, self._budget, self._sender_of = key, next_message, budget, sender_of
        self._all = TokenBucket(Budget(TAKEN_PER_DECODED * budget.rate_hz, TAKEN_PER_DECODED * budget.burst))
        self._senders: OrderedDict[str, TokenBucket] = OrderedDict()
        self._kept: T | None = None  # taken, and waits until it may be passed on
        self.refused = self.crowded = 0

    def messages(self, clock: Callable[[], float] = time.monotonic) -> Iterator[T]:
        """Yield those messages that may be decoded now."""
        for _ in range(self._budget.burst):
            # An empty ring is the usual case, hundreds of times a second: it costs one call.
            message = self._next() if self._kept is None else self._kept
            if message is None:
                return
            now_s = clock()
            if not self._all.take(now_s):
                self._kept = message
                self.crowded += 1
                return
            self._kept = None
            if self._bucket(self._sender_of(message)).take(now_s):
                yield message
            else:
                self.refused += 1

    def _bucket(self, sender: str) -> TokenBucket:
        """Return the bucket of a sender. The sender that was silent longest is forgotten where there are too many."""
        bucket = self._senders.pop(sender, None)
        if bucket is None:
            bucket = TokenBucket(self._budget)
            if len(self._senders) >= MOST_SENDERS:
                self._senders.popitem(last=False)
        self._senders[sender] = bucket
        return bucket


def floods(intakes: list[Intake[Any]]) -> Counter[str]:
    """Return the messages above the budgets by key: those refused, and times at which the ring held too many."""
    counts: Counter[str] = Counter()
    for intake in intakes:
        counts[intake.key] += intake.refused + intake.crowded
    return +counts
