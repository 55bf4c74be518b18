"""Pages of the published results: `python -m tests.benchmark.pages` writes docs/results/*.md, one for each question.

The figures are those of tests/benchmark/results/*.json, the words before them those of questions.toml; the page of
faults has the attacks of tests/faults/attacks.toml, too. A test checks that the pages are what this module makes.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Final

from tests.benchmark.results import PUBLISHED, QUESTIONS, ROOT, Column, read_result
from tests.faults import attacks

PAGES: Final = ROOT / "docs" / "results"
QUESTIONS_FILE: Final = Path(__file__).with_name("questions.toml")
INDEX: Final = "README.md"
ATTACKED: Final = "faults"  # the question whose page has the attacks


def page_name(question: str) -> str:
    """Return the file of a question."""
    return f"{question.replace(' ', '_')}.md"


def pages(published: Path = PUBLISHED) -> dict[str, str]:
    """Return the text of each page by its file name, the index among them."""
    words = tomllib.loads(QUESTIONS_FILE.read_text())
    results = [(path.name, read_result(path)) for path in sorted(published.glob("*.json"))]
    made = {
        page_name(question): _page(words[question], [one for one in results if one[1]["question"] == question])
        for question in QUESTIONS
    }
    made[page_name(ATTACKED)] += "\n" + "\n\n".join(attacks.sections()) + "\n"
    return made | {INDEX: _index(words, results)}


def _page(words: dict[str, str], results: list[tuple[str, dict[str, Any]]]) -> str:
    parts = [f"# {words['title']}", words["text"].strip()]
    parts += [_section(name, result) for name, result in results]
    return "\n\n".join(parts) + "\n"


def _section(name: str, result: dict[str, Any]) -> str:
    """Return the section of a table: remarks, where it comes from, figures."""
    columns = [Column(**column) for column in result["columns"]]
    lines = [f"| {' | '.join(column.head for column in columns)} |", f"{'|---' * len(columns)}|"]
    for row in result["rows"]:
        cells = (column.shown(cell).replace("|", "\\|") for column, cell in zip(columns, row, strict=True))
        lines.append(f"| {' | '.join(cells)} |")
    parts = [
        f"## {result['title']}",
        *(["\n".join(result["remarks"])] if result["remarks"] else []),
        f"```\n{result['command']}\n```",
        f"{_origin(result)} Data: `tests/benchmark/results/{name}`.",
        "\n".join(lines),
    ]
    return "\n\n".join(parts)


def _origin(result: dict[str, Any]) -> str:
    """Return a sentence about seeds, commit, date, machine and load."""
    load = "not recorded" if result["load"] is None else f"{result['load']:g}"
    return f"{_seeds(result['seeds'])} Commit {result['commit']}, {result['date']}; {result['machine']}; load {load}."


def _seeds(seeds: list[dict[str, Any]]) -> str:
    """Return the roles of the seeds, each with its families and ranges."""
    if not seeds:
        return "No rendered worlds."
    roles: dict[str, dict[str, list[int]]] = {}
    for seed in seeds:
        roles.setdefault(seed["role"], {}).setdefault(seed["family"], []).append(seed["seed"])
    return " ".join(
        f"Seeds of {role}: " + "; ".join(f"{family} {ranges(numbers)}" for family, numbers in of.items()) + "."
        for role, of in sorted(roles.items())
    )


def ranges(numbers: list[int]) -> str:
    """Return numbers as text, with consecutive ones as a range."""
    spans: list[list[int]] = []
    for number in sorted(set(numbers)):
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in spans)


def _index(words: dict[str, dict[str, str]], results: list[tuple[str, dict[str, Any]]]) -> str:
    lines = [words["index"]["text"].strip(), "", "| question | tables |", "|---|---|"]
    for question in QUESTIONS:
        titles = [
            f"[{result['title']}]({page_name(question)}#{_anchor(result['title'])})"
            for _, result in results
            if result["question"] == question
        ]
        if question == ATTACKED:
            titles += [f"[{title}]({page_name(question)}#{_anchor(title)})" for title in attacks.titles()]
        lines.append(f"| [{words[question]['title']}]({page_name(question)}) | {', '.join(titles)} |")
    return f"# {words['index']['title']}\n\n" + "\n".join(lines) + "\n"


def _anchor(title: str) -> str:
    """Return the anchor of a heading, as GitHub and GitLab make it."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def main() -> None:
    """Write the pages, and remove those of questions that are gone."""
    PAGES.mkdir(parents=True, exist_ok=True)
    made = pages()
    for old in set(PAGES.glob("*.md")) - {PAGES / name for name in made}:
        old.unlink()
    for name, text in made.items():
        (PAGES / name).write_text(text)
    print(f"{len(made)} pages in {PAGES.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
