"""Scripts of motor protocols, talked to by hand."""

from __future__ import annotations

from drivers.motors.motor_protocol import T, Transaction


class Unfinished(Exception):  # noqa: N818 - it is what was found
    """The script wants to hear more."""


def result(script: Transaction[T], *frames: bytes) -> T:
    """What a script returns once it has heard the frames; Unfinished where it goes on waiting."""
    next(script)
    try:
        for frame in frames:
            script.send(frame)
    except StopIteration as done:
        return done.value  # type: ignore[no-any-return]
    raise Unfinished


def told(script: Transaction[T]) -> bytes:
    """The first bytes that a script writes."""
    return next(script)
