"""TOML tables of settings, rigs and worlds as dataclasses or structs; their fields state types and ranges.

    @dataclass(frozen=True, slots=True)
    class Stereo:
        window_px: Annotated[int, Meta(ge=3, le=31), "side of the matching window, px"] = 11

    stereo = convert(Stereo, table_of(b"window_px = 9"))

Values are checked in `convert` by msgspec; a constructor checks nothing. An error is one line that names the dotted
path of the wrong key.

A rig or a configuration may come from a log of unknown origin, and the memory that tomllib needs grows with the square
of the nesting depth. The text is therefore bounded before it is parsed; embedded mask images do not count.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, fields, is_dataclass
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
_NAMED: Final = 200  # unknown keys in a message, which may be all of a file of an earlier version
MAX_NUMBER: Final = 1e300  # larger numbers overflow in products
# More than any rig needs: the largest covariance has 12,720 correlations of 17 characters, 216 kB.
MAX_CHARACTERS: Final = 1 << 19
MAX_DOTS: Final = 64  # of a key; the deepest one of a rig or a configuration has 2
_UNCOUNTED: Final = re.compile(r"""["']data:image/png;base64,[^"']*+["']|^[ \t]*+#.*+$""", re.MULTILINE)


def bytes_of(path: str | PathLike[str], most: int) -> bytes:
    """Return the content of a file of at most `most` bytes; raise ValueError for larger or unreadable files."""
    try:
        with open(path, "rb") as file:
            data = file.read(most + 1)
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(data) > most:
        raise ValueError(f"has more than {most} bytes: is it the right file?")
    return data


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text; raise ValueError for a malformed one, and for one beyond the limits of this module."""
    bare = _UNCOUNTED.sub("", text)
    if len(bare) > MAX_CHARACTERS:
        raise ValueError(f"more than {MAX_CHARACTERS} characters beside images of masks")
    if any(part.count(".") > MAX_DOTS for part in re.split(r"[=,\[\]{}\n]", bare)):
        raise ValueError(f"a key of more than {MAX_DOTS + 1} parts")
    return tomllib.loads(text)


def table_of(data: bytes) -> dict[str, Any]:
    """Return the table of TOML bytes; raise ValueError for bytes that are no TOML in UTF-8."""
    try:
        return parse_toml(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"expected TOML in UTF-8, found another byte at offset {error.start}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected TOML, found: {' '.join(str(error).split())}") from None


def convert(root: type[T], table: dict[str, Any], path: Path = ()) -> T:
    """Return the struct of a table; raise ValueError for an unknown or missing key and for a value out of its range.

    path: the position of the table within its file, for messages.
    """
    unknown, wrong = list[tuple[Any, Path]](), list[str]()
    found = _converted(root, table, path, unknown, wrong)
    if unknown:
        others = ", ".join(dotted(other) for _, other in unknown[1:_NAMED])
        raise ValueError(str(unknown_key(root, *unknown[0])) + (f"; unknown are also {others}" if others else ""))
    if wrong:
        raise ValueError(wrong[0])
    return found  # type: ignore[no-any-return]


def _converted(kind: Any, value: Any, path: Path, unknown: list[tuple[Any, Path]], wrong: list[str]) -> Any:
    """Convert a value to a type; collect errors in `wrong`, and section and path of unknown keys in `unknown`."""
    bare, _ = _bounded(kind)
    element = get_args(bare)[0] if get_origin(bare) is tuple else None
    # 1. A section, key by key.
    if is_section(kind) and isinstance(value, dict):
        own, types, faults = dict[str, Any](), types_of(kind), len(wrong) + len(unknown)
        for name, inner in value.items():
            if name in types:
                own[name] = _converted(types[name], inner, (*path, name), unknown, wrong)
            else:
                unknown.append((kind, (*path, name)))
        wrong += [f"{dotted((*path, name))} is missing" for name in _required(kind) if name not in value]
        try:
            return kind(**own) if len(wrong) + len(unknown) == faults else None
        except ValueError as error:
            wrong.append(f"{dotted(path)}: {error}")
            return None
    # 2. A list of sections.
    if is_section(element) and isinstance(value, list):
        names = [(*path[:-1], f"{path[-1]}[{number}]") for number in range(len(value))]
        return tuple(_converted(element, one, name, unknown, wrong) for one, name in zip(value, names, strict=True))
    # 3. A value.
    try:
        if _is_finite(value) and not is_section(kind):
            return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        pass
    wrong.append(f"{dotted(path)}: expected {described(kind)}, found {shown(value)}")
    return None


def _required(section: Any) -> list[str]:
    """Return the keys of a section that have no default."""
    if is_dataclass(section):
        return [one.name for one in fields(section) if one.default is MISSING and one.default_factory is MISSING]
    return [one.name for one in msgspec.structs.fields(section) if one.required]


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


def unknown_key(root: Any, section: Any, path: Path) -> ValueError:
    """Return the error for an unknown key. It names the replacement of a removed key, or a key with a similar name."""
    if instead := getattr(section, "REMOVED", {}).get(path[-1]):
        return ValueError(f"{dotted(path)} was removed: {instead}")
    neighbours = [(*path[:-1], name) for name in types_of(section)]
    known = list(key_paths(root))
    for candidates in (neighbours, [other for other in known if other[0] == path[0]], known):
        names = {other[-1]: other for other in reversed(candidates)}
        for near in difflib.get_close_matches(path[-1][:80], names, n=1, cutoff=0.7):
            return ValueError(f"unknown key {dotted(path)}: did you mean {dotted(names[near])}?")
    return ValueError(f"unknown key {dotted(path)}: known are {', '.join(map(dotted, neighbours))}")


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
    return not isinstance(value, int | float) or abs(value) < MAX_NUMBER
