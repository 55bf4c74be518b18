"""The check of the option --replace of commands that write a map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from omnid.errors import OmnidError


def require_replace(command: str, args: argparse.Namespace, maps: Sequence[Path]) -> None:
    """Raise OmnidError for an output that exists, unless it is one of the maps that are read or --replace is given."""
    output: Path = args.output
    is_read = any(path.exists() and output.exists() and path.samefile(output) for path in maps)
    if output.exists() and not (is_read or args.replace):
        raise OmnidError(f"{command}: {output} exists: --replace makes a new one")
