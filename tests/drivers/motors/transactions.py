"""Transactions of motor protocols, run with given frames."""

from __future__ import annotations

from drivers.motors.protocols.motor_protocol import T, Transaction


class UnfinishedError(Exception):
    """The transaction waits for more frames."""


def result(transaction: Transaction[T], *frames: bytes) -> T:
    """Return the result of a transaction that receives the frames; raise UnfinishedError if it waits for more."""
    next(transaction)
    try:
        for frame in frames:
            transaction.send(frame)
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]
    raise UnfinishedError


def written(transaction: Transaction[T]) -> bytes:
    """Return the first bytes that a transaction writes."""
    return next(transaction)
