"""Every record of attacks.toml names tests that exist."""

from __future__ import annotations

import argparse
import ast
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from tests.faults.attacks import Attack, rooms

ROOT = Path(__file__).parents[2]
COMMANDS = sorted({command for room in rooms() for attack in room.attacks for command in attack.tests})


@cache
def names(path: Path) -> list[str]:
    """Return the test functions of a file, or of all files in a folder."""
    files = sorted(path.rglob("test_*.py")) if path.is_dir() else [path]
    trees = [ast.parse(file.read_text("utf-8")) for file in files]
    return [
        node.name
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]


def named_tests(command: str) -> list[str]:
    """Return the test functions that a command chooses by path and name (`-k "one or another"`)."""
    parser = argparse.ArgumentParser()
    parser.add_argument("path", type=Path)
    parser.add_argument("-k", default="")
    parser.add_argument("-m", choices=["slow"])
    asked = parser.parse_args(shlex.split(command))
    found = names(ROOT / asked.path)
    if not asked.k:
        return found
    return [name for name in found if any(word in name for word in asked.k.split(" or "))]


def test_the_tests_of_an_attack_exist() -> None:
    assert [f"python -m pytest {command}" for command in COMMANDS if not named_tests(command)] == []


def test_a_command_without_a_test_is_found() -> None:
    assert named_tests("tests/faults/test_attacks.py -k without_a_test") == ["test_a_command_without_a_test_is_found"]
    assert named_tests("tests/faults/test_attacks.py -k 'never or exists_not'") == []
    with pytest.raises(FileNotFoundError):
        named_tests("tests/faults/test_gone.py")


def test_records_are_one_short_sentence_each_and_named_once() -> None:
    attacks: list[Attack] = [attack for room in rooms() for attack in room.attacks]
    assert [attack for attack in attacks if not (attack.outcome.endswith(".") and len(attack.outcome) < 200)] == []
    tried = [(attack.room, attack.tried) for attack in attacks]
    assert len(set(tried)) == len(tried) > 100
    words = re.compile(r"\b(before the mend|formerly|no longer|since then)\b")
    assert [attack for attack in attacks if words.search(attack.outcome)] == []
