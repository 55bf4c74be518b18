"""Settings: loaded from strict TOML, changed by overrides of the command line, and written as commented TOML.

The sections are dataclasses whose fields state their ranges, see calib/typed_toml.py: an unknown key is an error that
names its dotted path.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from functools import reduce
from os import PathLike
from typing import Any, Final, TypeVar, get_args

from calib.typed_toml import (
    Path,
    bytes_of,
    convert,
    described,
    dotted,
    is_section,
    key_paths,
    shown,
    table_of,
    types_of,
)
from omnid.errors import OmnidError

T = TypeVar("T")
_MAX_BYTES: Final = 1 << 20


def load(root: type[T], path: str | PathLike[str] | None = None, overrides: Sequence[str] = ()) -> T:
    """Return the settings of a TOML file, or the defaults without one, changed by overrides "stereo.window_px=11".

    Raises OmnidError for a file that cannot be read and for everything in it that is not exactly as declared.
    """
    if path is None:
        return parse(root, b"", origin="defaults", overrides=overrides)
    try:
        data = bytes_of(path, _MAX_BYTES)
    except ValueError as error:
        raise OmnidError(f"the settings file {str(path)!r} {error}") from None
    return parse(root, data, origin=str(path), overrides=overrides)


def parse(root: type[T], data: bytes, *, origin: str, overrides: Sequence[str] = ()) -> T:
    """Return the settings of TOML bytes that were read from `origin`; the rest is as in `load`."""
    changes = [_change(root, text) for text in ([overrides] if isinstance(overrides, str) else overrides)]
    try:
        table = table_of(data)
        for path, value in changes:
            _insert(table, path, value)
        return convert(root, table)
    except (ValueError, OmnidError) as error:
        raise OmnidError(f"{origin}: {error}") from None


def changed(settings: object) -> list[str]:
    """Return the dotted paths of the keys that differ from their defaults."""
    default = type(settings)()
    return [path for path in paths_of(type(settings)) if value_at(settings, path) != value_at(default, path)]


def paths_of(root: type) -> list[str]:
    """Return the dotted paths of all keys."""
    return [".".join(path) for path in key_paths(root)]


def value_at(settings: object, path: str) -> object:
    """Return the value at a dotted path."""
    return reduce(getattr, path.split("."), settings)


def dump(settings: object, wanted: Collection[str] | None = None) -> str:
    """Return commented TOML with the description, range and default of every key; `load` reads the same object.

    wanted: dotted paths of keys. With them, only these and the keys that differ from their defaults are listed, without
    ranges; a key with its default is commented out, so that it keeps that of the installed version.
    """
    chosen = None if wanted is None else {*wanted, *changed(settings)}
    return "\n".join(_lines(settings, type(settings)(), (), chosen)).strip("\n") + "\n"


def _change(root: type, text: str) -> tuple[Path, object]:
    """Return the path and the value of an override, which is checked by itself."""

    def check(value: object) -> object:
        table: dict[str, Any] = {}
        _insert(table, path, value)
        convert(root, table)
        return value

    name, equals, raw = text.partition("=")
    path, raw = tuple(part.strip() for part in name.split(".")), raw.strip()
    try:
        if not equals:
            raise ValueError("expected section.key=value, found no '='")
        if not raw.isprintable() and any("\ud800" <= letter <= "\udfff" for letter in raw):
            raise ValueError(f"{dotted(path)}: expected UTF-8, found {shown(raw)}")
        try:
            return path, check(_scalar(raw))
        except ValueError as error:
            with suppress(ValueError):
                return path, check(raw)  # a text needs no quotes around it
            raise error
    except (ValueError, OmnidError) as error:
        raise OmnidError(f"override {shown(text)}: {error}") from None


def _scalar(raw: str) -> object:
    """Return a value as TOML reads it, or the text itself where it is none."""
    try:
        table = table_of(f"value = {raw}".encode())
    except ValueError:
        return raw
    return table["value"] if table.keys() == {"value"} else raw


def _insert(table: dict[str, Any], path: Path, value: object) -> None:
    """Set a value in nested tables. Raise ValueError where a section would replace a value."""
    for depth, name in enumerate(path[:-1]):
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ValueError(f"{dotted(path[: depth + 1])}: expected a section, found {shown(table)}")
    table[path[-1]] = value


def _lines(settings: Any, default: Any, path: Path, wanted: Collection[str] | None) -> Iterator[str]:
    """Yield the lines of a section and of those within it; keys come first, because TOML wants them before tables.

    wanted: the dotted paths of the keys that are listed, without their ranges; None: all, with them.
    """
    types, lines = types_of(type(settings)), []
    for name, kind in types.items():
        if is_section(kind) or (wanted is not None and ".".join((*path, name)) not in wanted):
            continue
        value, usual = getattr(settings, name), getattr(default, name)
        lines.append(f"# {next(found for found in get_args(kind)[1:] if isinstance(found, str))}")
        if wanted is None:
            lines.append(f"# {described(kind)}; default {_toml(usual)}")
        is_off = wanted is not None and value == usual
        lines.append(f"{'# ' if is_off else ''}{name} = {_toml(value)}")
    if lines and path:
        yield from ("", f"[{'.'.join(path)}]")
    yield from lines
    for name, kind in types.items():
        if is_section(kind):
            yield from _lines(getattr(settings, name), getattr(default, name), (*path, name), wanted)


def _toml(value: object) -> str:
    """Return a bool, number, text or tuple as a TOML value."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(element) for element in value) + "]"
    if isinstance(value, str):  # JSON's escapes are TOML's, except that TOML wants DEL escaped as well
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
