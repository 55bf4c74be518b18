"""Drops, errors and stamps of buffers as drivers fill them in."""

from __future__ import annotations

import pytest

from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.v4l2_buffers import WARNING, BufferAccounting, CameraState

PERIOD_NS = 33_333_000
START_NS = 5_000 * 10**9
DELAY_NS = 2_000_000


class Books:
    """A ledger with what it said, fed with buffers in a few words."""

    def __init__(self) -> None:
        self.state, self.said = CameraState(), list[tuple[int, str]]()
        self.ledger = BufferAccounting(
            "lower camera", self.state, lambda severity, text: self.said.append((severity, text))
        )

    def admit(self, sequence: int, *, stamp_ns: int, arrival_ns: int, flags: int = v4l2.TIMESTAMP_MONOTONIC,
              size: int = 100) -> int | None:  # fmt: skip
        buffer = v4l2.V4l2Buffer(sequence=sequence % 2**32, flags=flags, bytesused=size)
        buffer.timestamp.tv_sec, rest_ns = divmod(stamp_ns, 10**9)
        buffer.timestamp.tv_usec = rest_ns // 1000
        return self.ledger.admit(buffer, arrival_ns, 100)

    def regular(self, *sequences: int, flags: int = v4l2.TIMESTAMP_MONOTONIC, size: int = 100) -> list[int | None]:
        """Buffers whose stamps and arrivals follow from their sequence."""
        stamps = [START_NS + PERIOD_NS * sequence for sequence in sequences]
        return [self.admit(sequence, stamp_ns=stamp_ns, arrival_ns=stamp_ns + DELAY_NS, flags=flags, size=size)
                for sequence, stamp_ns in zip(sequences, stamps, strict=True)]  # fmt: skip


@pytest.fixture
def books() -> Books:
    return Books()


def test_whole_images_keep_the_kernels_stamp(books: Books) -> None:
    assert books.regular(0, 1, 2) == [START_NS, START_NS + PERIOD_NS, START_NS + 2 * PERIOD_NS]
    assert books.state == CameraState() and books.said == []


@pytest.mark.parametrize(
    ("sequences", "drops"), [((7, 8, 10, 14), 4), ((2**32 - 2, 2**32 + 1), 2), ((3, 3 + 2**30), 2**30 - 1)]
)
def test_gaps_are_drops_also_over_the_wrap(books: Books, sequences: tuple[int, ...], drops: int) -> None:
    books.regular(*sequences)
    assert (books.state.drops, books.state.restarts) == (drops, 0)


@pytest.mark.parametrize("again", [0, 99, 100])
def test_a_sequence_that_starts_again_drops_nothing(books: Books, again: int) -> None:
    books.regular(100)
    books.admit(again, stamp_ns=START_NS + 101 * PERIOD_NS, arrival_ns=START_NS + 102 * PERIOD_NS)
    assert (books.state.drops, books.state.restarts) == (0, 1)


def test_a_stream_that_begins_anew_drops_nothing(books: Books) -> None:
    books.regular(0, 1)
    books.ledger.begin()
    books.regular(50, 51)
    assert (books.state.drops, books.state.restarts) == (0, 0)


@pytest.mark.parametrize("broken", [{"flags": v4l2.TIMESTAMP_MONOTONIC | v4l2.BUFFER_ERROR}, {"size": 99}, {"size": 0}])
def test_broken_buffers_are_errors_and_no_drops(books: Books, broken: dict[str, int]) -> None:
    assert None not in books.regular(0, 1)
    assert books.regular(2, 3, **broken) == [None, None]
    assert None not in books.regular(4)
    assert (books.state.errors, books.state.drops) == (2, 0)


@pytest.mark.parametrize("flags", [0, 0x4000])
def test_an_unknown_clock_is_taken_and_told_of_once(books: Books, flags: int) -> None:
    assert books.regular(0, 1, flags=flags) == [START_NS, START_NS + PERIOD_NS]
    assert [severity for severity, _ in books.said] == [WARNING]
    assert books.said[0][1].startswith("lower camera: ") and "clock" in books.said[0][1]


def test_stamps_of_the_future_become_the_arrival(books: Books) -> None:
    """vivid stamps the end of the frame, 50 ms ahead, by default."""
    arrivals = [START_NS + PERIOD_NS * i for i in range(5)]
    stamps = [books.admit(i, stamp_ns=at_ns + 50_000_000, arrival_ns=at_ns) for i, at_ns in enumerate(arrivals)]
    assert stamps == arrivals
    assert books.state.restamped == 5 and len(books.said) == 1 and "50.000 ms" in books.said[0][1]


@pytest.mark.parametrize("stamp_ns", [0, START_NS - 11 * 10**9, 1_700_000_000 * 10**9])
def test_stamps_of_another_clock_become_the_arrival(books: Books, stamp_ns: int) -> None:
    assert books.admit(0, stamp_ns=stamp_ns, arrival_ns=START_NS) == START_NS
    assert books.state.restamped == 1


def test_stamps_never_go_back(books: Books) -> None:
    first = books.admit(0, stamp_ns=START_NS, arrival_ns=START_NS + 10)
    again = books.admit(1, stamp_ns=START_NS - 1000, arrival_ns=START_NS + PERIOD_NS)
    at_once = books.admit(2, stamp_ns=START_NS, arrival_ns=START_NS + PERIOD_NS)
    assert (first, again, at_once) == (START_NS, START_NS + PERIOD_NS, START_NS + PERIOD_NS + 1)
    assert books.state.restamped == 2


def test_what_is_wrong_throughout_is_said_once(books: Books) -> None:
    for i in range(100):
        books.admit(i, stamp_ns=START_NS * (1 + i), arrival_ns=START_NS + i, flags=0)
    assert len(books.said) == 2 and all("\n" not in text for _, text in books.said)
