"""Budgets of keys and senders."""

from __future__ import annotations

from collections import deque

from omnid.transport.intake import MOST_SENDERS, TAKEN_PER_DECODED, Budget, Intake, TokenBucket

BUDGET = Budget(10.0, 5)


def intake(ring: deque[str]) -> Intake[str]:
    return Intake("cmd/x", lambda: ring.popleft() if ring else None, BUDGET, lambda message: message[0])


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    bucket = TokenBucket(BUDGET)
    assert [bucket.take(100.0) for _ in range(6)] == [True] * 5 + [False]
    assert bucket.take(100.11) and not bucket.take(100.12)
    assert sum(bucket.take(200.0) for _ in range(10)) == 5


def test_a_sender_has_its_own_budget_and_the_key_has_one() -> None:
    ring = deque("a" * 9 + "b")
    found = intake(ring)
    taken = [message for _ in range(4) for message in found.messages(lambda: 50.0)]
    assert taken == ["a"] * 5 + ["b"] and found.refused == 4 and found.crowded == 0
    ring.extend("c" * 100)
    for _ in range(20):
        list(found.messages(lambda: 50.0))
    assert len(ring) == 99 - (TAKEN_PER_DECODED * 5 - 10) and found.crowded > 0, "the rest is left in the ring"
    assert found.refused == 9, "the one that waits is not lost"
    assert list(found.messages(lambda: 50.0 + 0.1)) == ["c"]


def test_an_empty_ring_uses_nothing_up() -> None:
    ring: deque[str] = deque()
    found = intake(ring)
    for _ in range(1000):
        assert list(found.messages(lambda: 50.0)) == []
    ring.append("a")
    assert list(found.messages(lambda: 50.0)) == ["a"]


def test_invented_senders_take_no_memory() -> None:
    ring, now_s = deque[str](), [50.0]
    found = Intake("cmd/x", lambda: ring.popleft() if ring else None, BUDGET, lambda message: message)
    for number in range(1000):
        ring.append(str(number))
        now_s[0] += 1.0
        assert list(found.messages(lambda: now_s[0])) == [str(number)]
    assert len(found._senders) == MOST_SENDERS
