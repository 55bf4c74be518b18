"""Settings as commented TOML that `omnid.settings.load` reads back."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import is_dataclass
from typing import Any, TypeAlias

from omnid.settings import changed, described, fields_of, knob_of

_Path: TypeAlias = tuple[str, ...]


def dump(settings: object) -> str:
    """Return commented TOML with the description, range and default of every knob; `load` reads the same object."""
    return "\n".join(_dumped(settings, type(settings)(), ())).strip("\n") + "\n"


def dump_minimal(settings: object, shown: Collection[str]) -> str:
    """Return TOML with the knobs that differ from their defaults; all others keep those of the installed version.

    shown: dotted paths of knobs that are listed in any case, commented out where they have their default.
    """
    wanted = {*changed(settings), *shown}
    return "\n".join(_minimal(settings, type(settings)(), (), wanted)).strip("\n") + "\n"


def _dumped(settings: Any, default: Any, path: _Path) -> Iterator[str]:
    """Yield the lines of a section and of those within it; knobs come first, because TOML wants them before tables."""
    if path:
        yield from ("", f"[{'.'.join(path)}]")
    for entry, kind in fields_of(type(settings)):
        if not is_dataclass(kind):
            about = knob_of(entry)
            yield f"# {about.doc}"
            yield f"# {described(kind, about)}; default {_toml(getattr(default, entry.name))}"
            yield f"{entry.name} = {_toml(getattr(settings, entry.name))}"
    for entry, kind in fields_of(type(settings)):
        if is_dataclass(kind):
            yield from _dumped(getattr(settings, entry.name), getattr(default, entry.name), (*path, entry.name))


def _minimal(settings: Any, default: Any, path: _Path, wanted: Collection[str]) -> Iterator[str]:
    """Yield the lines of the wanted knobs of a section and of those within it."""
    lines = []
    for entry, kind in fields_of(type(settings)):
        if not is_dataclass(kind) and ".".join((*path, entry.name)) in wanted:
            value = getattr(settings, entry.name)
            mark = "# " if value == getattr(default, entry.name) else ""
            lines += [f"# {knob_of(entry).doc}", f"{mark}{entry.name} = {_toml(value)}"]
    if lines:
        yield from ("", f"[{'.'.join(path)}]", *lines)
    for entry, kind in fields_of(type(settings)):
        if is_dataclass(kind):
            here = (*path, entry.name)
            yield from _minimal(getattr(settings, entry.name), getattr(default, entry.name), here, wanted)


def _toml(value: object) -> str:
    """Return a bool, number, text or tuple as a TOML value."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(element) for element in value) + "]"
    if isinstance(value, str):  # JSON's escapes are TOML's, except that TOML wants DEL escaped as well
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
