"""Answers to requests as JSON: anything else is none."""

from __future__ import annotations

import pytest

from omnid.transport.requests import answer_of


@pytest.mark.parametrize("payload", [b"", b"{}", b"[1]", b"null", b'{"done": 1}', b"\xff", b"[" * 100_000])
def test_what_is_no_answer_is_none(payload: bytes) -> None:
    assert answer_of(payload) is None
