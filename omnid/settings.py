"""Settings: loaded from strict TOML, changed by overrides of the command line, and written as commented TOML.

The sections are dataclasses whose fields state their ranges, see calib/typed_toml.py: an unknown key is an error that
names its dotted path.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import reduce
from os import PathLike
from typing import Any, TypeVar, get_args

from calib.typed_toml import (
    Path,
    bytes_of,
    convert,
    described,
    is_section,
    key_paths,
    shown,
    table_of,
    toml_value,
    types_of,
)
from calib.validation import MAX_FILE_BYTES
from omnid.errors import OmnidError

T = TypeVar("T")


def load(root: type[T], path: str | PathLike[str] | None = None, overrides: Sequence[str] = ()) -> T:
    """Return the settings of a TOML file, or the defaults without one, changed by overrides "stereo.window_px=11".

    Raises OmnidError for a file that cannot be read and for everything in it that is not exactly as declared.
    """
    if path is None:
        return parse(root, b"", origin="defaults", overrides=overrides)
    try:
        data = bytes_of(path, MAX_FILE_BYTES)
    except ValueError as error:
        raise OmnidError(f"the settings file {str(path)!r} {error}") from None
    return parse(root, data, origin=str(path), overrides=overrides)


def parse(root: type[T], data: bytes, *, origin: str, overrides: Sequence[str] = ()) -> T:
    """Return the settings of TOML bytes that were read from `origin`; the rest is as in `load`."""
    changes = [_override(root, text) for text in ([overrides] if isinstance(overrides, str) else overrides)]
    try:
        table = table_of(data)
        for change in changes:
            _merge(table, change)
        return convert(root, table)
    except ValueError as error:
        raise OmnidError(f"{origin}: {error}") from None


def changed(settings: object) -> list[str]:
    """Return the dotted paths of the keys that differ from their defaults."""
    paths, default = map(".".join, key_paths(type(settings))), type(settings)()
    return [path for path in paths if value_at(settings, path) != value_at(default, path)]


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


def _override(root: type, text: str) -> dict[str, Any]:
    """Return the table of an override, which is checked by itself."""
    name, equals, raw = (part.strip() for part in text.partition("="))
    errors = list[ValueError]()
    try:
        if not equals:
            raise ValueError("expected section.key=value, found no '='")
        if any("\ud800" <= letter <= "\udfff" for letter in raw):
            raise ValueError(f"{name}: expected UTF-8, found {shown(raw)}")
        for value in (_scalar(raw), raw):  # a text needs no quotes around it
            table: Any = reduce(lambda below, part: {part.strip(): below}, reversed(name.split(".")), value)
            try:
                convert(root, table)
                return dict(table)
            except ValueError as error:
                errors.append(error)
        raise errors[0]
    except ValueError as error:
        raise OmnidError(f"override {shown(text)}: {error}") from None


def _scalar(raw: str) -> object:
    """Return a value as TOML reads it, or the text itself where it is none."""
    try:
        table = table_of(f"value = {raw}".encode())
    except ValueError:
        return raw
    return table["value"] if table.keys() == {"value"} else raw


def _merge(table: dict[str, Any], change: dict[str, Any]) -> None:
    """Set the values of a table of changes in another one."""
    for name, value in change.items():
        if isinstance(value, dict) and isinstance(table.get(name), dict):
            _merge(table[name], value)
        else:
            table[name] = value


def _lines(settings: Any, default: Any, path: Path, wanted: Collection[str] | None) -> Iterator[str]:
    """Yield the lines of a section and of those within it; keys come first, because TOML wants them before tables.

    wanted: the dotted paths of the keys that are listed, without their ranges; None: all, with them.
    """
    types, lines = types_of(type(settings)), []
    for name, kind in types.items():
        if is_section(kind) or (wanted is not None and ".".join((*path, name)) not in wanted):
            continue
        value, default_value = getattr(settings, name), getattr(default, name)
        lines.append(f"# {next(found for found in get_args(kind)[1:] if isinstance(found, str))}")
        if wanted is None:
            lines.append(f"# {described(kind)}; default {toml_value(default_value)}")
        is_off = wanted is not None and value == default_value
        lines.append(f"{'# ' if is_off else ''}{name} = {toml_value(value)}")
    if lines and path:
        yield from ("", f"[{'.'.join(path)}]")
    yield from lines
    for name, kind in types.items():
        if is_section(kind):
            yield from _lines(getattr(settings, name), getattr(default, name), (*path, name), wanted)
