"""docs/safety.md: each hazard has a test that is marked with it, and each reason to stop says whether it disarms."""

from __future__ import annotations

import re
from pathlib import Path

from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC, MANUAL

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs/safety.md").read_text("utf-8")
MARK = re.compile(r"@pytest\.mark\.hazard\(([^)]*)\)")


def test_each_hazard_has_a_test_that_is_marked_with_it() -> None:
    hazards = re.findall(r"^\| (H\d+) \|", TEXT, re.MULTILINE)
    marks = {
        hazard
        for path in (ROOT / "tests").rglob("test_*.py")
        for names in MARK.findall(path.read_text("utf-8"))
        for hazard in re.findall(r"H\d+", names)
    }
    assert len(hazards) == len(set(hazards))
    assert set(hazards) == marks


def test_every_reason_to_stop_has_a_row_that_says_whether_it_disarms() -> None:
    """A row may have several reasons of one kind: it has the beginnings of the words of each."""
    rows = {
        cells[1].strip(): cells[3].strip()
        for line in TEXT.splitlines()
        if line.startswith("| ") and len(cells := line.split("|")) == 7
    }
    for rule in safety_rules.RULES:
        words = [word[:5] for word in rule.reason.split() if len(word) > 3]
        found = [row for row in rows if all(word in row for word in words)]
        assert found, f"add a row for {rule.reason!r} to the table of docs/safety.md"
        if rule.reason not in (safety_rules.ENDS, safety_rules.NOT_ARMED):
            latches = rule.disarms or rule.reason == safety_rules.ASKED
            assert rows[min(found, key=len)].startswith("yes" if latches else "no"), rule.reason
    assert f'controller.arming = "{MANUAL}"' in TEXT and f'"{AUTOMATIC}"' in TEXT
