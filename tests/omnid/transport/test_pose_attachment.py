"""The attachment of a pose: JSON that is bounded, with defaults for what is missing."""

from __future__ import annotations

import pytest

from omnid.errors import OmnidError
from omnid.transport.pose_attachment import PoseAttachment


def test_an_attachment_comes_back() -> None:
    given = PoseAttachment(7, "tracking", 1, 50, 60, 123)
    assert PoseAttachment.from_bytes(given.to_bytes()) == given


def test_missing_entries_those_of_another_type_and_unknown_ones_leave_the_defaults() -> None:
    found = PoseAttachment.from_bytes(b'{"seq": 3, "state": 5, "resets": 1.5, "inliers": true, "colour": "red"}')
    assert found == PoseAttachment(seq=3)


@pytest.mark.parametrize("data", [b"", b"[1]", b"{", b"\xff", b"[" * 4000, b'{"seq": 3}' + b" " * 4096])
def test_anything_but_a_short_object_is_refused(data: bytes) -> None:
    with pytest.raises(OmnidError, match=f"the {len(data)} bytes attached to a pose"):
        PoseAttachment.from_bytes(data)
