"""The words of the code: standard terms, plain docstrings; see "Style" in CONTRIBUTING.md."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("calib", "drivers", "omnid", "tests")

# Private words and what stands in their place. They are refused as a word of an identifier: agreeing, most_agreeing.
WORDS = {
    "sight": "frame", "sights": "frames", "ego": "estimate", "agreeing": "inliers", "liked": "is_candidate",
    "rival": "runner_up", "helm": "controller", "heard": "received", "remark": "log_record",
    "logbook": "statistics", "tally": "run_statistics", "verdict": "warnings", "heed": "handle", "amiss": "wrong",
    "anew": "again", "whoever": "callers", "nobody": "none", "grave": "severity", "mailbox": "inbox",
    "keepers": "writers", "eyes": "cameras", "picture": "image", "pictures": "images", "spoken": "outgoing",
    "said": "published", "told": "published", "nudge": "parameters", "deviation": "sigma", "ledger": "accounting",
    "doubts": "warnings", "crooked": "misaligned", "unheard": "ignored", "untold": "lost",
}  # fmt: skip
PROSE = ("whoever", "nobody", "amiss", "anew", "heed", "heeds", "sight", "sights", "crookedness", "logbook")
FIRST_WORDS = ("What", "Whether", "Where", "How", "Which", "Who", "Whose", "Why", "When")
# Only files in which one of these occurs are tokenized or parsed, which takes much longer.
ANY_WORD = re.compile("|".join(WORDS))
ANY_FIRST_WORD = re.compile(rf"""["'](?:\\?\s)*(?:{"|".join(FIRST_WORDS)})\s""")


def python_files() -> list[Path]:
    """Return all files of the project but this one."""
    return [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py")) if path != Path(__file__)]


def identifiers(text: str) -> set[str]:
    """Return the names in a file."""
    return {
        token.string for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type == tokenize.NAME
    }


def words_of(identifier: str) -> list[str]:
    """Split PaddedPanorama, max_error_px into lower-case words."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", identifier).lower().split("_")


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and text of each docstring."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text


def relative(path: Path) -> str:
    """Return the path below the project's folder."""
    return path.relative_to(ROOT).as_posix()


def test_identifiers_use_standard_terms() -> None:
    texts = {path: path.read_text("utf-8") for path in python_files()}
    found = [
        f"{relative(path)}: {name} ({WORDS[word]}?)"
        for path, text in texts.items()
        if ANY_WORD.search(text.lower())
        for name in sorted(identifiers(text))
        for word in words_of(name)
        if word in WORDS
    ]
    assert found == []


def test_comments_and_texts_use_ordinary_words() -> None:
    pattern = re.compile(rf"\b({'|'.join(PROSE)})\b", re.IGNORECASE)
    found = [
        f"{relative(path)}:{number}: {line.strip()}"
        for path in python_files()
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if pattern.search(line)
    ]
    assert found == []


def test_docstrings_begin_with_a_verb_or_a_noun() -> None:
    texts = {path: path.read_text("utf-8") for path in python_files()}
    found = [
        f"{relative(path)}:{line}: {text.splitlines()[0]}"
        for path, source in texts.items()
        if ANY_FIRST_WORD.search(source)
        for line, text in docstrings(ast.parse(source))
        if text.split()[0] in FIRST_WORDS
    ]
    assert found == []


def test_no_class_stands_in_two_modules() -> None:
    places: dict[str, list[str]] = {}
    for path in python_files():
        if relative(path).startswith("tests/"):
            continue
        for name in re.findall(r"^class (\w+)", path.read_text("utf-8"), re.MULTILINE):
            places.setdefault(name, []).append(relative(path))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


@pytest.mark.parametrize(
    ("identifier", "words"),
    [("most_agreeing", ["most", "agreeing"]), ("HelmLink", ["helm", "link"]), ("T_odom_rig", ["t", "odom", "rig"])],
)
def test_an_identifier_is_split_into_its_words(identifier: str, words: list[str]) -> None:
    assert words_of(identifier) == words
