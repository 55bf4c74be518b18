"""Mutants of source code: places and changes."""

from __future__ import annotations

import pytest

from tests.faults.mutants import TESTS, Mutant, all_mutants, mutants_of

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


@pytest.mark.parametrize("folder", TESTS)
def test_there_are_mutants_of_the_code_that_moves_the_wheels(folder: str) -> None:
    assert len(list(all_mutants([folder]))) > 3
