"""What a check found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warning", "wrong"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    level: Level
    subject: str
    found: str
    mend: str = ""  # what to do about it

    def __str__(self) -> str:
        return f"{self.level:<8} {self.subject:<13} {self.found}" + (f"; {self.mend}" if self.mend else "")


def verdict(findings: Sequence[Finding]) -> str:
    """The last line."""
    wrong, warnings = (sum(finding.level == level for finding in findings) for level in ("wrong", "warning"))
    if not wrong and not warnings:
        return f"all {len(findings)} checks are ok"
    return f"{wrong} wrong, {warnings} to be looked at, {len(findings) - wrong - warnings} ok"
