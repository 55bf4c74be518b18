"""Differences between the keys of two tables, by their dotted paths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

ABSENT: Final = "nothing"
_MAX_VALUE: Final = 60  # characters


class KeyDifference(NamedTuple):
    """A key whose values differ; the values as one short line each."""

    path: str  # section.key, list[3]
    a: str
    b: str


def table_differences(a: Mapping[str, object], b: Mapping[str, object]) -> list[KeyDifference]:
    """Return the keys of two TOML tables that differ, in the order of the first, then those only in the second."""
    of_a, of_b = dict(_leaves(a, "")), dict(_leaves(b, ""))
    return [
        KeyDifference(path, _shown(of_a, path), _shown(of_b, path))
        for path in {**of_a, **of_b}
        if not _same(of_a, of_b, path)
    ]


def _leaves(value: object, path: str) -> Iterator[tuple[str, object]]:
    """Yield every value that is neither a table nor a list, with its path."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and value:
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{path}[{number}]")
    else:
        yield path, value


def _same(a: Mapping[str, object], b: Mapping[str, object], path: str) -> bool:
    """True if both have the same value: 1 and 1.0 are the same setting, true and 1 are not."""
    if path not in a or path not in b:
        return False
    first, second = a[path], b[path]
    return first == second and isinstance(first, bool) == isinstance(second, bool)


def _shown(leaves: Mapping[str, object], path: str) -> str:
    if path not in leaves:
        return ABSENT
    text = ascii(leaves[path]) if isinstance(leaves[path], str) else str(leaves[path])
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]}... ({len(text)} characters)"
