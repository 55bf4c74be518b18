"""SAFETY.md names tests that exist, and every reason to stop with what it does."""

from __future__ import annotations

import re
from pathlib import Path

from omnid.core.control import safety_rules
from omnid.core.control.arming import AUTOMATIC, MANUAL

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "omnid/controller/SAFETY.md").read_text("utf-8")


def test_every_test_that_it_names_exists() -> None:
    named = set(re.findall(r"`(test_\w+)`", TEXT))
    existing = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text("utf-8"), re.MULTILINE)
    }
    assert len(named) > 30 and named - existing == set()


def test_every_row_of_a_hazard_names_a_test() -> None:
    rows = TEXT.partition("## Hazards")[2].partition("\n\n")[0].splitlines()[3:]
    assert len(rows) > 15 and all("`test_" in row.split("|")[3] for row in rows)


def test_every_reason_to_stop_has_a_row_that_says_whether_it_disarms() -> None:
    rows = {
        cells[1].split(" (")[0].strip(): cells[3].strip()
        for line in TEXT.splitlines()
        if line.startswith("| ") and len(cells := line.split("|")) == 7
    }
    for rule in safety_rules.RULES:
        assert rule.reason in rows, f"add a row for {rule.reason!r} to the table of SAFETY.md"
        if rule.reason not in (safety_rules.ENDS, safety_rules.NOT_ARMED):
            latches = rule.disarms or rule.reason == safety_rules.ASKED
            assert rows[rule.reason].startswith("yes" if latches else "no"), rule.reason
    assert f'controller.arming = "{MANUAL}"' in TEXT and f'"{AUTOMATIC}"' in TEXT
