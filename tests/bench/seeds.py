"""Roles of seeds: development, validation, held-out. The one list is seeds.toml."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Final

from tests.simulation.recipes import RECIPES

FILE: Final = Path(__file__).with_name("seeds.toml")
DEVELOPMENT: Final = "development"
ROLES: Final = (DEVELOPMENT, "validation", "held-out")
ANY: Final = "any"


def role_of(family: str, seed: int) -> str:
    """Return the role of a seed; a list of the family comes before one of all families."""
    tables = _tables()
    for table in (tables.get(family, {}), tables[ANY]):
        for role, ranges in table.items():
            if any(_holds(text, seed) for text in ranges):
                return role
    return DEVELOPMENT


def family_and_seed(folder: str) -> tuple[str, int] | None:
    """Return recipe and seed of a log's folder, named NAME_sSEED with any words between; None for another name."""
    found = re.fullmatch(r"(\w+?)_[a-z]?(\d+)", folder)
    names = [name for name in RECIPES if found and f"{found[1]}_".startswith(f"{name}_")]
    return (max(names, key=len), int(found[2])) if found and names else None


def _holds(text: str, seed: int) -> bool:
    first, _, last = text.partition("-")
    return int(first) <= seed <= int(last or first)


@cache
def _tables() -> dict[str, dict[str, list[str]]]:
    tables = tomllib.loads(FILE.read_text())
    unknown = {role for table in tables.values() for role in table} - set(ROLES)
    if unknown:
        raise ValueError(f"{FILE}: a role is one of {', '.join(ROLES)}, not {', '.join(sorted(unknown))}")
    return tables
