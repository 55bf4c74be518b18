"""A settings file as a bounded table of TOML."""

from __future__ import annotations

from os import PathLike
from typing import Any, Final

from calib.bounded_toml import parse_toml
from omnid.errors import OmnidError

_MAX_BYTES: Final = 1 << 20


def read_table(path: str | PathLike[str]) -> dict[str, Any]:
    """Return the table of a TOML file; OmnidError where it cannot be read."""
    try:
        return table_of(bytes_of(path))
    except OmnidError as error:
        raise OmnidError(f"{path}: {error}") from None


def bytes_of(path: str | PathLike[str]) -> bytes:
    """Return the content of a settings file; OmnidError where it cannot be read or is too large for one."""
    try:
        with open(path, "rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OmnidError(f"cannot read the settings file {str(path)!r}: {reason}") from None
    if len(data) > _MAX_BYTES:
        raise OmnidError(f"the settings file {str(path)!r} has more than {_MAX_BYTES} bytes: is it the right file?")
    return data


def table_of(data: bytes) -> dict[str, Any]:
    """Return the table of TOML bytes; OmnidError where they are none."""
    try:
        return parse_toml(data.decode())
    except UnicodeDecodeError as error:
        raise OmnidError(f"expected TOML in UTF-8, found another byte at offset {error.start}") from None
    except (ValueError, RecursionError) as error:
        raise OmnidError(f"expected TOML, found: {' '.join(str(error).split())}") from None
