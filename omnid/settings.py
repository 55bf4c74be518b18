"""Frozen dataclasses from strict TOML and back: an unknown key is an error that names its dotted path.

    @dataclass(frozen=True, slots=True)
    class Stereo:
        window_px: int = knob(11, "side of the matching window, px", low=3, high=31)

    @dataclass(frozen=True, slots=True)
    class Config:
        stereo: Stereo = field(default_factory=Stereo)

    config = load(Config, "omnid.toml", ["stereo.window_px=9"])

A renamed or removed key is refused with its new name: `load(..., renamed={"stereo.side": "stereo.window_px"})`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass
from functools import reduce
from os import PathLike
from types import MappingProxyType
from typing import Any, Final, TypeVar, cast, get_args, get_origin, get_type_hints

from calib.bounded_toml import parse_toml
from omnid.errors import OmnidError
from omnid.settings_file import bytes_of, table_of
from omnid.settings_keys import Keys, Path, dotted, shown

T = TypeVar("T")
_MISFIT: Final = object()
_KINDS: Final[dict[Any, tuple[str, str]]] = {
    bool: ("true or false", "booleans"),
    int: ("an integer", "integers"),
    float: ("a number", "numbers"),
    str: ("a string", "strings"),
}


@dataclass(frozen=True, slots=True)
class Knob:
    """Description and range of a setting; for a tuple, of each element."""

    doc: str
    low: float | None  # inclusive, as is high
    high: float | None
    choices: tuple[Any, ...]

    def allows(self, value: Any) -> bool:
        """True if a value of the right type is in range."""
        if isinstance(value, float) and not math.isfinite(value):
            return False
        if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
            return False  # an argument that was not UTF-8
        if self.choices:
            return value in self.choices
        return (self.low is None or value >= self.low) and (self.high is None or value <= self.high)

    @property
    def bounds(self) -> str:
        """The range in words, with a leading blank; empty where all values are allowed."""
        if self.choices:
            return ", one of " + ", ".join(repr(choice) for choice in self.choices)
        if self.low is None:
            return "" if self.high is None else f" of at most {self.high}"
        return f" of at least {self.low}" if self.high is None else f" from {self.low} to {self.high}"


def knob(
    default: T,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: Sequence[Any] = (),
) -> T:
    """Declare a field: its default, a description with its unit, its range. Numbers are finite."""
    return field(default=default, metadata={"knob": Knob(doc, low, high, tuple(choices))})


def load(
    root: type[T],
    path: str | PathLike[str] | None = None,
    overrides: Sequence[str] = (),
    *,
    renamed: Mapping[str, str] = MappingProxyType({}),
) -> T:
    """Return the settings of a TOML file, or the defaults without one, changed by overrides "stereo.window_px=11".

    renamed: old dotted path of a key or a section -> its new path, or a sentence where no key takes its place.
    Raises OmnidError for a file that cannot be read and for everything in it that is not exactly as declared.
    """
    data, origin = (b"", "defaults") if path is None else (bytes_of(path), str(path))
    return parse(root, data, origin=origin, overrides=overrides, renamed=renamed)


def parse(
    root: type[T],
    data: bytes,
    *,
    origin: str,
    overrides: Sequence[str] = (),
    renamed: Mapping[str, str] = MappingProxyType({}),
) -> T:
    """Return the settings of TOML bytes that were read from `origin`; the rest is as in `load`."""
    keys = Keys(tuple(_paths(root)), renamed)
    changes = [
        _parsed_override(root, text, keys) for text in ([overrides] if isinstance(overrides, str) else overrides)
    ]
    try:
        table = table_of(data)
        for path, value in changes:
            insert(table, path, value)
        return cast("T", _built(root(), table, (), keys))
    except OmnidError as error:
        raise OmnidError(f"{origin}: {error}") from None


def from_table(root: type[T], table: dict[str, Any], origin: str, renamed: Mapping[str, str]) -> T:
    """Return the settings of a table that was read from `origin`; the rest is as in `load`."""
    try:
        return cast("T", _built(root(), table, (), Keys(tuple(_paths(root)), renamed)))
    except OmnidError as error:
        raise OmnidError(f"{origin}: {error}") from None


def changed(settings: object) -> list[str]:
    """Return the dotted paths of the knobs that differ from their defaults."""
    default = type(settings)()
    return [path for path in knob_paths(type(settings)) if value_at(settings, path) != value_at(default, path)]


def knob_paths(root: type) -> list[str]:
    """Return the dotted paths of all knobs."""
    return [".".join(path) for path in _paths(root)]


def value_at(settings: object, path: str) -> object:
    """Return the value at a dotted path."""
    return reduce(getattr, path.split("."), settings)


def _parsed_override(root: type, text: str, keys: Keys) -> tuple[Path, object]:
    name, equals, raw = text.partition("=")
    path = tuple(part.strip() for part in name.split("."))
    if not equals:
        raise OmnidError(f"override {shown(text)}: expected section.key=value, found no '='")
    try:
        kind, entry = _entry_at(root, path, keys)
        value = _scalar(raw.strip())
        if kind is str and not isinstance(value, str):
            value = raw.strip()
        return path, _checked(kind, entry, value, path)
    except OmnidError as error:
        raise OmnidError(f"override {shown(text)}: {error}") from None


def _scalar(raw: str) -> object:
    try:
        table = parse_toml(f"value = {raw}")
    except (ValueError, RecursionError):
        return raw
    return table["value"] if table.keys() == {"value"} else raw


def _entry_at(root: type, path: Path, keys: Keys) -> tuple[Any, Knob]:
    kind: Any = root
    for depth, name in enumerate(path):
        if not is_dataclass(kind):
            raise OmnidError(f"{dotted(path[:depth])} is a key, not a section: it has no {dotted(path[depth:])}")
        entries = {entry.name: (hint, entry) for entry, hint in fields_of(kind)}
        if name not in entries:
            raise keys.moved(path) or keys.unknown(path[: depth + 1])
        kind, entry = entries[name]
    if is_dataclass(kind):
        first = next(_paths(cast("type", kind), path))
        raise OmnidError(f"{dotted(path)} is a section: name one of its keys, such as {dotted(first)}")
    return kind, knob_of(entry)


def insert(table: dict[str, Any], path: Path, value: object) -> None:
    """Set a value in nested tables; OmnidError where a section would replace a value."""
    for depth, name in enumerate(path[:-1]):
        inner = table.setdefault(name, {})
        _require_section(inner, path[: depth + 1])
        table = inner
    table[path[-1]] = value


def _built(default: object, table: dict[str, Any], path: Path, keys: Keys) -> object:
    entries = fields_of(type(default))
    for name in table.keys() - {entry.name for entry, _ in entries}:
        raise keys.moved(_first_leaf(table[name], (*path, name))) or keys.unknown((*path, name))
    values: dict[str, object] = {}
    for entry, kind in entries:
        here, value = (*path, entry.name), getattr(default, entry.name)
        if is_dataclass(kind):
            inner = table.get(entry.name, {})
            _require_section(inner, here)
            values[entry.name] = _built(value, inner, here, keys)
        else:
            values[entry.name] = _checked(kind, knob_of(entry), table.get(entry.name, value), here)
    return type(default)(**values)


def _checked(kind: Any, entry: Knob, value: object, path: Path) -> object:
    fitted = _fitted(kind, entry, value)
    if fitted is _MISFIT:
        raise OmnidError(f"{dotted(path)}: expected {described(kind, entry)}, found {shown(value)}")
    return fitted


def _fitted(kind: Any, entry: Knob, value: Any) -> object:
    """Return the value as the knob's type, or _MISFIT. A bool is no int; an int is allowed for a float."""
    if get_origin(kind) is tuple:
        return _fitted_tuple(get_args(kind), entry, value)
    if kind is float and type(value) is int and abs(value) < 1 << 1023:
        value = float(value)
    return value if type(value) is kind and entry.allows(value) else _MISFIT


def _fitted_tuple(kinds: tuple[Any, ...], entry: Knob, value: Any) -> object:
    if not isinstance(value, (list, tuple)):
        return _MISFIT
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        return _MISFIT
    fitted = tuple(_fitted(kind, entry, element) for kind, element in zip(kinds, value, strict=True))
    return _MISFIT if _MISFIT in fitted else fitted


def _require_section(value: object, path: Path) -> None:
    if not isinstance(value, dict):
        raise OmnidError(f"{dotted(path)}: expected a section, found {shown(value)}")


def _first_leaf(value: object, path: Path) -> Path:
    """Return the path of the first key below a value of a TOML file, or that of the value where it is no section."""
    while isinstance(value, dict) and value:
        name, value = next(iter(value.items()))
        path = (*path, name)
    return path


def _paths(cls: type, path: Path = ()) -> Iterator[Path]:
    """Yield the paths of all knobs."""
    for entry, kind in fields_of(cls):
        here = (*path, entry.name)
        if is_dataclass(kind):
            yield from _paths(cast("type", kind), here)
        else:
            yield here


def fields_of(cls: Any) -> list[tuple[Field[Any], Any]]:
    """Return the fields of a dataclass of settings with their types: knobs, and sections, which are dataclasses."""
    hints = get_type_hints(cls)
    return [(entry, hints[entry.name]) for entry in fields(cls)]


def knob_of(entry: Field[Any]) -> Knob:
    """Return the description of a field that is no section."""
    if "knob" not in entry.metadata:
        raise TypeError(f"'{entry.name}' is neither a knob(...) nor a section, that is a dataclass")
    return cast("Knob", entry.metadata["knob"])


def described(kind: Any, entry: Knob) -> str:
    """Return type and range of a knob in words."""
    if get_origin(kind) is not tuple:
        return _KINDS[kind][0] + entry.bounds
    kinds = get_args(kind)
    length = "" if kinds[-1] is Ellipsis else f"{len(kinds)} "
    return f"a list of {length}{_KINDS[kinds[0]][1]}{entry.bounds}"
