"""Settings files of earlier versions: keys that were renamed are moved to their new places."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from typing import Any, TypeVar

from omnid.settings import from_table, insert
from omnid.settings_file import read_table

T = TypeVar("T")


def load_renamed(root: type[T], path: str | PathLike[str], renamed: Mapping[str, str]) -> tuple[T, list[str]]:
    """Return the settings of a TOML file with its renamed keys under their new names, and a line for each of these.

    renamed: as in `omnid.settings.load`. Raises OmnidError as `load` does, also for a removed key.
    """
    table = read_table(path)
    lines = [
        line
        for old in sorted(renamed, key=lambda old: -old.count("."))  # keys before their sections
        for line in _moved(table, tuple(old.split(".")), renamed[old])
    ]
    return from_table(root, table, str(path), renamed), lines


def _moved(table: dict[str, Any], old: tuple[str, ...], new: str) -> Iterator[str]:
    """Move a key or a section, if it is there, to its new place; yield a line about it."""
    section: Any = table
    for name in old[:-1]:
        section = section.get(name) if isinstance(section, dict) else None
    if not isinstance(section, dict) or old[-1] not in section or " " in new:
        return
    value, target = section.pop(old[-1]), tuple(new.split("."))
    if isinstance(value, dict):
        for name, inner in value.items():
            insert(table, (*target, name), inner)
    else:
        insert(table, target, value)
    yield f"{'.'.join(old)} is now called {new}"
