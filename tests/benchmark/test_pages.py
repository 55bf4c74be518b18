"""The pages of docs/results are what the generator makes from the published results."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmark.pages import PAGES, pages, ranges
from tests.benchmark.results import PUBLISHED, read_result


@pytest.mark.parametrize("path", sorted(PUBLISHED.glob("*.json")), ids=lambda path: path.stem)
def test_published_results_follow_the_schema_and_the_roles_of_seeds(path: Path) -> None:
    assert read_result(path)["rows"]


def test_pages_are_made_from_the_results() -> None:
    made = pages()
    assert {path.name for path in PAGES.glob("*.md")} == set(made)
    for name, text in made.items():
        assert (PAGES / name).read_text() == text, f"{name}: run `python -m tests.benchmark.pages`"


def test_consecutive_seeds_are_a_range() -> None:
    assert ranges([3, 1, 2, 7, 9, 10]) == "1 to 3, 7, 9 to 10"
