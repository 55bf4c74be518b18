"""Requests of a drive in lock-step never wait, and a sink calls its function."""

from __future__ import annotations

from itertools import islice
from typing import Any, cast

from omnid.simulation.lockstep_parts import LockstepRequests, Take


def test_each_turn_has_the_requests_since_the_last_one() -> None:
    requests, some = LockstepRequests(), [cast("Any", object()) for _ in range(3)]
    batches = requests.batches()
    requests.put(some[0])
    requests.put(some[1])
    assert list(islice(batches, 2)) == [some[:2], []]
    requests.put(some[2])
    assert next(batches) == some[2:]
    requests.end()
    assert list(batches) == []


def test_a_message_is_taken() -> None:
    taken = list[int]()
    Take(taken.append).process(7)
    assert taken == [7]
