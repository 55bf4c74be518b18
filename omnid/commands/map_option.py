"""The options --map, --localize-only and --tags of `omnid run` and `omnid replay`; --replace of commands that write
a map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from omnid.errors import OmnidError


def add_map(parser: argparse.ArgumentParser) -> None:
    """Add --map, --localize-only and --tags."""
    group = parser.add_argument_group("map of places")
    group.add_argument(
        "--map",
        type=Path,
        metavar="FILE.omap",
        help="localise in a map of places and extend it at the end; a file that does not exist is made; the points of "
        "the 3-D map are written by `omnid replay --cloud FILE.ply`",
    )
    group.add_argument("--localize-only", action="store_true", help="leave the map as it is")
    add_tags_option(group)


def add_tags_option(parser: argparse._ActionsContainer) -> None:
    """Add --tags."""
    parser.add_argument(
        "--tags",
        type=Path,
        metavar="TAGS.toml",
        help="AprilTags (36h11) that are to be landmarks of the map, with names, numbers and sizes; the map keeps them",
    )


def add_replace(parser: argparse._ActionsContainer) -> None:
    """Add --replace."""
    parser.add_argument("--replace", action="store_true", help="replace it, with all places that routes refer to")


def require_replace(command: str, args: argparse.Namespace, maps: Sequence[Path]) -> None:
    """Raise OmnidError for an output that exists, unless it is one of the maps that are read or --replace is given."""
    output: Path = args.output
    is_read = any(path.exists() and output.exists() and path.samefile(output) for path in maps)
    if output.exists() and not (is_read or args.replace):
        raise OmnidError(f"{command}: {output} exists: --replace makes a new one")


def map_settings(args: argparse.Namespace) -> dict[str, object]:
    """Return the settings that the options stand for. Raises OmnidError for a name that is no map's."""
    if args.map is not None and args.map.suffix == ".ply":
        raise OmnidError(
            f"--map {args.map}: expected a map of places (.omap) to localise in; the points of the 3-D "
            "map are written by --cloud FILE.ply"
        )
    localize_only = "true" if args.localize_only else None
    return {"places.map": args.map, "places.tags": args.tags, "places.localize_only": localize_only}
