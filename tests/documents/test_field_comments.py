"""Comments of fields as descriptions of the API page; needs griffe, of the extra docs."""

from __future__ import annotations

import pytest

pytest.importorskip("griffe")

from tests.documents.field_comments import comment_of

LINES = [
    "class Pose:",
    "    x_m: float  # forward",
    "    # Of the body,",
    "    # in its axes.",
    "    sigma: float",
    "    state: str = '#'",
]


@pytest.mark.parametrize(("number", "comment"), [(2, "forward"), (5, "Of the body, in its axes."), (6, "")])
def test_a_field_is_described_by_its_comment(number: int, comment: str) -> None:
    assert comment_of(LINES, number) == comment
