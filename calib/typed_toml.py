"""TOML tables of settings, rigs and worlds as dataclasses or structs; their fields state types and ranges.

    @dataclass(frozen=True, slots=True)
    class Stereo:
        window_px: Annotated[int, Meta(ge=3, le=31), "side of the matching window, px"] = 11

    stereo = convert(Stereo, table_of(b"window_px = 9"))

Values are checked by msgspec, in one call. An error is one line that names the dotted path of the wrong key.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from functools import cache
from os import PathLike
from types import MappingProxyType, NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Final,
    Literal,
    TypeAlias,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
from msgspec import Meta

T = TypeVar("T")
Path: TypeAlias = tuple[str, ...]
_NAMES: Final = MappingProxyType(
    {
        bool: ("true or false", "booleans"),
        int: ("an integer", "integers"),
        float: ("a number", "numbers"),
        str: ("a string", "strings"),
    }
)
_SHOWN: Final = 60  # characters of a value in a message


def bytes_of(path: str | PathLike[str], limit: int) -> bytes:
    """Return the content of a file of at most `limit` bytes; raise ValueError for larger or unreadable files."""
    try:
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(data) > limit:
        raise ValueError(f"has more than {limit} bytes: is it the right file?")
    return data


def table_of(data: bytes) -> dict[str, Any]:
    """Return the table of TOML bytes; raise ValueError for bytes that are no TOML in UTF-8."""
    # The time of tomllib grows with the square of the parts of a key, and keys have one line.
    dots = [line.count(b".") for line in data.splitlines()]
    if len(dots) > 10_000 or max(dots, default=0) > 256:
        raise ValueError(f"expected at most 10000 lines of 256 dots, found {len(dots)} of up to {max(dots)} dots")
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"expected TOML in UTF-8, found another byte at offset {error.start}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected TOML, found: {' '.join(str(error).split())}") from None


def toml_value(value: object) -> str:
    """Return a value as TOML, rows one a line; a number parses to the same bits, but -0 is written as 0."""
    if isinstance(value, list | tuple):
        if value and isinstance(value[0], list | tuple):
            return "\n".join(["[", *(f"    {toml_value(row)}," for row in value), "]"])
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, str):  # JSON's escapes are TOML's, except that TOML wants DEL escaped as well
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if type(value) is int else repr(float(value) + 0.0)  # type: ignore[arg-type]


def convert(root: type[T], table: dict[str, Any], path: Path = ()) -> T:
    """Return the struct of a table; raise ValueError for an unknown or missing key and for a value out of its range.

    path: the position of the table within its file, for messages.
    """
    _require_known(root, table, path)
    try:
        return msgspec.convert(table, root)
    except msgspec.ValidationError as error:
        raise ValueError(_explained(str(error), root, table, path)) from None


def _require_known(section: Any, table: dict[str, Any], path: Path) -> None:
    """Raise ValueError for an unknown key of a table, and for a number that is not finite."""
    types = types_of(section)
    for name, value in table.items():
        place = (*path, name)
        if name not in types:
            known = ", ".join(dotted((*path, other)) for other in types)
            raise ValueError(f"unknown key {dotted(place)}: known are {known}")
        kind = types[name]
        if is_section(kind) and isinstance(value, dict):
            _require_known(kind, value, place)
        elif (element := _element(kind)) is not None and isinstance(value, list):
            for number, one in enumerate(value):
                if isinstance(one, dict):
                    _require_known(element, one, (*path, f"{name}[{number}]"))
        elif not _is_finite(value):
            raise ValueError(f"{dotted(place)}: expected {described(kind)}, found {shown(value)}")


def _explained(error: str, root: Any, table: dict[str, Any], path: Path) -> str:
    """Return an error of msgspec with the path of the key, as TOML has it, and with what was expected and found."""
    kind: Any = root
    value: Any = table
    names = path
    text, _, place = error.partition(" - at `$")
    # 1. Follow the place through sections and lists of sections, up to a key.
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", place):
        if name and is_section(kind):
            kind, value, names = types_of(kind)[name], value[name], (*names, name)
        elif index and (element := _element(kind)) is not None:
            kind, value, names = element, value[int(index)], (*names[:-1], f"{names[-1]}[{index}]")
    # 2. A key is missing, the section's own check failed, or the value of a key is wrong.
    if is_section(kind) and isinstance(value, dict):
        missing = re.search(r"missing required field `(\w+)`", text)
        return f"{dotted((*names, missing[1]))} is missing" if missing else f"{dotted(names)}: {text}"
    return f"{dotted(names)}: expected {described(kind)}, found {shown(value)}"


def _element(kind: Any) -> Any:
    """Return the section of which a type is a list; None for other types."""
    bare, _ = _bounded(kind)
    element = get_args(bare)[0] if get_origin(bare) is tuple else None
    return element if is_section(element) else None


def dotted(path: Sequence[str]) -> str:
    """Return a path as it is written in TOML."""
    return ".".join(part if re.fullmatch(r"[\w-]{1,80}(\[\d+\])?", part) else shown(part) for part in path)


def shown(value: object) -> str:
    """Return a value from a file on one short line."""
    if isinstance(value, dict):
        return "a section"
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists of lists of lists
        return f"a huge {type(value).__name__}"
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def is_section(kind: Any) -> bool:
    """True for the type of a section."""
    return isinstance(kind, type) and (is_dataclass(kind) or issubclass(kind, msgspec.Struct))


def _types_of(section: Any) -> dict[str, Any]:
    """Return the types of the keys of a section, with their annotations.

    A field of a dataclass without a text in its annotation is no key: a parameter of a method that files do not set.
    """
    hints = get_type_hints(section, include_extras=True)
    present = {name: _unless_absent(kind) for name, kind in hints.items() if get_origin(kind) is not ClassVar}
    if not is_dataclass(section):
        return present
    texts = {
        name for name, kind in present.items() if any(isinstance(one, str) for one in getattr(kind, "__metadata__", ()))
    }
    return {name: kind for name, kind in present.items() if is_section(kind) or name in texts}


types_of: Callable[[Any], dict[str, Any]] = cache(_types_of)


def _unless_absent(kind: Any) -> Any:
    """Return X for the type X | None of an optional key, any other type as it is."""
    present = [part for part in get_args(kind) if part is not NoneType]
    return present[0] if get_origin(kind) in (Union, UnionType) and len(present) == 1 else kind


def key_paths(section: Any, path: Path = ()) -> Iterator[Path]:
    """Yield the paths of all keys that are no sections."""
    for name, kind in types_of(section).items():
        if is_section(kind):
            yield from key_paths(kind, (*path, name))
        else:
            yield (*path, name)


def described(kind: Any) -> str:
    """Return type and range of a key in words."""
    kind, bounds = _bounded(kind)
    if get_origin(kind) is dict or is_section(kind):
        return "a section"
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(repr(choice) for choice in get_args(kind))
    if get_origin(kind) is tuple:
        elements = get_args(kind)
        length = "" if elements[-1] is Ellipsis else f"{len(elements)} "
        if get_origin(elements[0]) is tuple:
            return f"{length}rows of {_NAMES[get_args(elements[0])[0]][1]}{bounds}"
        element, each = _bounded(elements[0])
        return f"a list of {length}{_NAMES.get(element, ('', 'tables'))[1]}{each}{bounds}"
    return _NAMES.get(kind, ("another type", ""))[0] + bounds


def _bounded(kind: Any) -> tuple[Any, str]:
    """Return a type without its annotation, and its range in words with a leading blank."""
    if get_origin(kind) is not Annotated:
        return kind, ""
    bare, meta = get_args(kind)[0], next((found for found in get_args(kind)[1:] if isinstance(found, Meta)), Meta())
    low, high = (meta.ge if meta.gt is None else meta.gt), meta.le
    if meta.max_length is not None:
        return bare, f", {meta.min_length or 0} to {meta.max_length} of them"
    if low is None:
        return bare, "" if high is None else f" of at most {high}"
    if high is None:
        return bare, f" above {low}" if meta.ge is None else f" of at least {low}"
    return bare, f" from {low} to {high}"


def _is_finite(value: object) -> bool:
    """True if all numbers in a value, which may be a list, are finite."""
    if isinstance(value, list):
        return all(map(_is_finite, value))
    try:
        return not isinstance(value, int | float) or math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False
