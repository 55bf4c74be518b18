"""Validation of parsed TOML and YAML: errors name the file, the dotted key, the expected and the found value."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from calib import se3
from calib.bounded_toml import parse_toml
from calib.errors import CalibError
from calib.models.camera import Array

# Larger than any calibration with two embedded masks.
MAX_FILE_BYTES = 16_000_000
SHOWN_CHARACTERS = 80  # Most characters of a value, so that a message stays one line.
MAX_SIDE_PX = 32767  # because OpenCV's remap takes no larger images
MAX_PIXELS = 64 * 2**20  # because a mask of one byte a pixel must fit the memory
# Larger numbers would overflow in products.
MAX_NUMBER = 1e300
# A rotation typed with few digits is made orthonormal, so that one that a program wrote is not changed.
ORTHONORMAL_TOLERANCE = 1e-9


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """Read a calibration file of at most limit bytes."""
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except OSError as error:
        raise CalibError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(data) > limit:
        raise CalibError(f"{path}: expected a calibration file, found more than {limit} bytes")
    return data


def decode(data: bytes | str, name: str) -> str:
    """Return the text of a calibration file, UTF-8."""
    try:
        return data if isinstance(data, str) else data.decode()
    except UnicodeDecodeError as error:
        raise CalibError(f"{name}: expected UTF-8 text, found byte {data[error.start]!r} at {error.start}") from error


def shown(value: object) -> str:
    """Return the value's representation, shortened to one line."""
    text = repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else text[:SHOWN_CHARACTERS] + " ..."


@dataclass(frozen=True, slots=True)
class ValidatedTable:
    """A table of a file with typed look-ups that raise CalibError; path is its dotted name, "" at the top."""

    values: Mapping[Any, Any]
    file: str
    path: str = ""

    def fail(self, key: str, expected: str) -> NoReturn:
        """Raise CalibError for the value of a key."""
        found = shown(self.values[key]) if key in self.values else "nothing"
        raise CalibError(f"{self.file}: {self._dotted(key)}: expected {expected}, found {found}")

    def allow_only(self, known: Collection[str]) -> None:
        """Raise CalibError for unknown keys: a misspelt one must not stand for its default."""
        unknown = [str(key) for key in self.values if key not in known]
        if unknown:
            raise CalibError(
                f"{self.file}: {self._dotted(repr(unknown[0])[1:-1][:SHOWN_CHARACTERS])}: unknown key, "
                f"expected one of {', '.join(sorted(known))}"
            )

    def has(self, key: str) -> bool:
        """True if the table has the key."""
        return key in self.values

    def table(self, key: str) -> ValidatedTable:
        """Return the table under a key."""
        if not isinstance(self.values.get(key), Mapping):
            self.fail(key, "a table")
        return ValidatedTable(self.values[key], self.file, self._dotted(key))

    def tables(self, key: str, most: int) -> list[ValidatedTable]:
        """Return the tables of an array under a key, at most `most`; none where the key is missing."""
        found = self.values.get(key, [])
        if not (isinstance(found, list) and len(found) <= most and all(isinstance(item, Mapping) for item in found)):
            self.fail(key, f"at most {most} tables [[{self._dotted(key)}]]")
        return [ValidatedTable(item, self.file, f"{self._dotted(key)}[{number}]") for number, item in enumerate(found)]

    def points(self, key: str, least: int, most: int) -> list[tuple[float, float]]:
        """Return the points [x, y] under a key, least to most of them."""
        found = self.values.get(key)
        items: list[Any] = found if isinstance(found, list) and least <= len(found) <= most else [None]
        if not all(isinstance(item, list) and len(item) == 2 and all(map(_is_number, item)) for item in items):
            self.fail(key, f"{least} to {most} points [x, y]")
        return [(float(x), float(y)) for x, y in items]

    def text(self, key: str) -> str:
        """Return the string under a key."""
        value = self.values.get(key)
        return value if isinstance(value, str) else self.fail(key, "a string")

    def choice(self, key: str, options: Collection[str]) -> str:
        """Return the string under a key, one of the options."""
        value = self.values.get(key)
        return value if isinstance(value, str) and value in options else self.fail(key, " or ".join(options))

    def number(self, key: str) -> float:
        """Return the finite number under a key."""
        value: Any = self.values.get(key)
        return float(value) if _is_number(value) else self.fail(key, "a finite number")

    def numbers(self, key: str, count: int = 0) -> tuple[float, ...]:
        """Return the finite numbers under a key; count 0: at least one."""
        value = self.values.get(key)
        sized = isinstance(value, list) and (len(value) == count if count else len(value) > 0)
        if not sized or not all(_is_number(item) for item in value or ()):
            self.fail(key, f"{count or 'one or more'} finite numbers")
        return tuple(float(item) for item in value or ())

    def size(self, key: str) -> tuple[int, int]:
        """Return the image size (width, height) [px] under a key."""
        value = self.values.get(key)
        whole = isinstance(value, list) and [type(item) for item in value] == [int, int]
        width, height = value if whole and value else (0, 0)
        if not is_image_size(width, height):
            self.fail(key, f"[width, height] in pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in all")
        return width, height

    def transform(self, key: str) -> Array:
        """Return the rigid transform (4, 4) under a key."""
        value = self.values.get(key)
        square = isinstance(value, list) and len(value) == 4
        if not square or not all(isinstance(row, list) and len(row) == 4 for row in value or ()):
            self.fail(key, "4 rows of 4 numbers")
        if not all(_is_number(item) for row in value or () for item in row):
            self.fail(key, "4 rows of 4 finite numbers")
        T = np.array(value, float)
        return rigid(T) if se3.is_rigid(T) else self.fail(key, "a rotation and a translation over 0 0 0 1")

    def _dotted(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


def rigid(T: Array) -> Array:
    """Return T (4, 4) with an orthonormal rotation; T itself if its rotation is already orthonormal."""
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() <= ORTHONORMAL_TOLERANCE:
        return T
    left, _, right = np.linalg.svd(R)
    return se3.transform(left @ right, T[:3, 3])


def is_image_size(width: float, height: float) -> bool:
    """True if images of this size [px] are supported."""
    return min(width, height) >= 1 and max(width, height) <= MAX_SIDE_PX and width * height <= MAX_PIXELS


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < MAX_NUMBER


def toml_table(text: str | bytes, name: str) -> ValidatedTable:
    """Parse a TOML text and return its top table; name is used in error messages."""
    try:
        return ValidatedTable(parse_toml(decode(text, name)), name)
    except (RecursionError, ValueError) as error:
        raise CalibError(f"{name}: not a TOML file: {error}") from error


def require_schema(table: ValidatedTable, version: int) -> None:
    """Raise CalibError for a file of another schema version."""
    found = table.values.get("schema")
    if type(found) is not int or found != version:
        table.fail("schema", f"version {version}")
