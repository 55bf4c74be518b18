"""rosbags reads recordings; it is a dependency, so this test always runs (tested with rosbags 0.11.9)."""

from __future__ import annotations

from rosbags.highlevel import AnyReader

from tests.interop.conftest import Known
from tests.interop.known import Expected, plain


def test_rosbags_reads_the_numbers_that_were_written(known: Known) -> None:
    found: Expected = {}
    with AnyReader([known.path]) as bag:
        for place, _, data in bag.messages():
            found.setdefault(place.topic, []).append(plain(bag.deserialize(data, place.msgtype)))
    assert found == known.expected
