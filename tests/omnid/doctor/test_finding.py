"""Result of a check."""

from __future__ import annotations

import pytest

from omnid.doctor.finding import Finding, summary


@pytest.mark.parametrize(
    ("found", "line"),
    [(["ok", "ok"], "all 2 checks are ok"), (["ok", "error", "warning"], "1 errors, 1 warnings, 1 ok")],
)
def test_summarises_the_findings(found: list[str], line: str) -> None:
    assert summary([Finding(level, "", "") for level in found]) == line  # type: ignore[arg-type]
