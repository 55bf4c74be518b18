"""Accounting of missing and broken buffers, as drivers fill them in."""

from __future__ import annotations

import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraState
from drivers.cameras.v4l2_buffers import BufferAccounting

MIN_BYTES = 100


class Counter:
    """An accounting with its state, fed with sequence numbers."""

    def __init__(self) -> None:
        self.state = CameraState()
        self.accounting = BufferAccounting(self.state)

    def accept(self, *sequences: int, flags: int = v4l2.TIMESTAMP_MONOTONIC, size: int = MIN_BYTES) -> list[bool]:
        buffers = [v4l2.V4l2Buffer(sequence=sequence % 2**32, flags=flags, bytesused=size) for sequence in sequences]
        return [self.accounting.accept(buffer, MIN_BYTES) for buffer in buffers]


@pytest.fixture
def counter() -> Counter:
    return Counter()


def test_accepts_complete_images(counter: Counter) -> None:
    assert counter.accept(0, 1, 2) == [True, True, True]
    assert counter.state == CameraState()


@pytest.mark.parametrize(
    ("sequences", "drops"), [((7, 8, 10, 14), 4), ((2**32 - 2, 2**32 + 1), 2), ((3, 3 + 2**30), 2**30 - 1)]
)
def test_counts_gaps_as_drops_across_the_overflow_too(counter: Counter, sequences: tuple[int, ...], drops: int) -> None:
    counter.accept(*sequences)
    assert (counter.state.drops, counter.state.restarts) == (drops, 0)


@pytest.mark.parametrize("again", [0, 99, 100])
def test_a_restarted_sequence_drops_nothing(counter: Counter, again: int) -> None:
    counter.accept(100, again)
    assert (counter.state.drops, counter.state.restarts) == (0, 1)


def test_a_new_stream_drops_nothing(counter: Counter) -> None:
    counter.accept(0, 1)
    counter.accounting.restart()
    counter.accept(50, 51)
    assert (counter.state.drops, counter.state.restarts) == (0, 0)


@pytest.mark.parametrize("broken", [{"flags": v4l2.TIMESTAMP_MONOTONIC | v4l2.BUFFER_ERROR}, {"size": 99}, {"size": 0}])
def test_counts_broken_buffers_as_errors_and_not_as_drops(counter: Counter, broken: dict[str, int]) -> None:
    assert counter.accept(0, 1) == [True, True]
    assert counter.accept(2, 3, **broken) == [False, False]
    assert counter.accept(4) == [True]
    assert (counter.state.errors, counter.state.drops) == (2, 0)
