"""Mutants of source code: places and changes."""

from __future__ import annotations

from itertools import islice

import pytest

from tests.faults.mutants import ROOT, TESTS, Mutant, all_mutants, in_order, mutants_of

SOURCE = '''"""Text of 3 words."""
LIMIT: int = 5

def low(x: int, y: int = 2) -> bool:
    """Return 1."""
    return not abs(x) < LIMIT and y == -3
'''


def changed(mutant: Mutant) -> str:
    return mutant.apply(SOURCE).splitlines()[mutant.line - 1].strip()


def test_each_place_is_changed_once() -> None:
    assert sorted(changed(mutant) for mutant in mutants_of("x.py", SOURCE)) == sorted(
        [
            "LIMIT: int = (5 + 1)",
            "def low(x: int, y: int = (2 + 1)) -> bool:",
            "return abs(x) < LIMIT and y == -3",
            "return not (x) < LIMIT and y == -3",
            "return not abs(x) <= LIMIT and y == -3",
            "return not abs(x) < LIMIT or y == -3",
            "return not abs(x) < LIMIT and y != -3",
            "return not abs(x) < LIMIT and y == 3",
            "return not abs(x) < LIMIT and y == -(3 + 1)",
        ]
    )


def test_those_that_differ_only_at_a_limit_are_tried_last() -> None:
    path = "omnid/core/navigation/forecast.py"
    source = (ROOT / path).read_text("utf-8")
    texts = [
        mutant.text
        for mutant in in_order({mutant.described(source): mutant for mutant in mutants_of(path, source)}).values()
    ]
    first = next(place for place, text in enumerate(texts) if text in ("<", "<=", ">", ">="))
    assert 0 < first < len(texts) - 1 and set(texts[first:]) <= {"<", "<=", ">", ">="}


@pytest.mark.parametrize("folder", TESTS)
def test_there_are_mutants_of_the_code_that_moves_the_wheels(folder: str) -> None:
    assert len(list(islice(all_mutants([folder]), 4))) == 4
