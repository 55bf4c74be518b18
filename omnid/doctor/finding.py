"""Result of a check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report: level, what was checked, what was found, what to do."""

    level: Level
    subject: str
    found: str
    advice: str = ""  # what to do

    def __str__(self) -> str:
        return f"{self.level:<8} {self.subject:<13} {self.found}" + (f"; {self.advice}" if self.advice else "")


def ok(subject: str, found: str) -> Finding:
    """Return a finding that needs nothing."""
    return Finding("ok", subject, found)


def warning(subject: str, found: str, advice: str) -> Finding:
    """Return a finding that a person should think about."""
    return Finding("warning", subject, found, advice)


def error(subject: str, found: str, advice: str = "") -> Finding:
    """Return a finding with which the daemon does not do its work."""
    return Finding("error", subject, found, advice)


def summary(findings: Sequence[Finding]) -> str:
    """Return the last line of the report."""
    errors, warnings = (sum(finding.level == level for finding in findings) for level in ("error", "warning"))
    if not errors and not warnings:
        return f"all {len(findings)} checks are ok"
    return f"{errors} errors, {warnings} warnings, {len(findings) - errors - warnings} ok"
