"""`omnid map tags|align`: AprilTags as landmarks, and the alignment of a map with a plan of the building by them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from omnid.commands.json_output import print_json
from omnid.commands.map_option import require_replace
from omnid.commands.options import JSON, MAP, REPLACE, SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:
    from omnid.core.places.map_tags import MapTag
    from omnid.core.places.place_map import PlaceMap
    from omnid.core.places.place_rig import PlaceRig
    from omnid.core.places.tags import TagEstimate
    from omnid.engine.telemetry import Telemetry
    from omnid.stages.front_end import FrontEnd

# Tags by id, the poses of those that were found, and how many views were refused.
Found: TypeAlias = "tuple[dict[int, MapTag], dict[int, TagEstimate], int]"
LARGEST_M = 0.3  # A larger error at a landmark means that a number was mistyped.


@command(
    option("source", type=Path, metavar="FILE.omap|LOG", help="a map, or a log as of `omnid replay`"),
    option(
        "--tag",
        action="append",
        default=[],
        metavar="ID=SIZE",
        help="of a log: number of a tag and the edge of its black square, m; may be repeated",
    ),
    option("--rig", type=Path, help="the rig.toml of the cameras; default: that attached to the log"),
    option("--write", type=Path, metavar="TAGS.toml", help="write them as landmarks, for `omnid map align`"),
    MAP,
    *SETTINGS,
    JSON,
    examples=(
        "map tags place.omap",
        "map tags drive.mcap --tag 5=0.16 --tag 6=0.16 --map place.omap --localize-only --write tags.toml",
    ),
)
def tags(args: argparse.Namespace) -> int:
    """Print the poses of the tags; return 1 if one was not found."""
    from omnid.core.places.alignment import landmark
    from omnid.formats.landmark_file import write_landmarks
    from omnid.sinks.files import check_outputs

    if args.write is not None:
        read = (args.source, args.tags, args.map, args.rig, args.config)
        check_outputs([("--write", args.write)], [("the file that is read", path) for path in read if path is not None])
    tags, found, refused = _of_map(args) if args.source.suffix == ".omap" else _of_log(args)
    rows = [_row(tags[id], tag) for id, tag in found.items()]
    if args.json:
        print_json({"tags": rows, "refused": refused})
    elif rows:
        print(*_tag_lines(rows), sep="\n")
    else:
        print(f"no tag in {args.source}")
    if args.write is not None:
        write_landmarks(
            args.write, [replace(landmark(id, tags[id].size_m, tag.T), name=tags[id].name) for id, tag in found.items()]
        )
    missing = tags.keys() - found.keys()
    if missing:
        print(
            f"omnid: not found, or in several places: {', '.join(map(str, sorted(missing)))}; {refused} views were of "
            "another size",
            file=sys.stderr,
        )
    return int(bool(missing))


def _of_map(args: argparse.Namespace) -> Found:
    """Return the tags of a map, their poses, and 0."""
    from omnid.formats.place_file import read_places

    if args.tag or args.tags or args.rig or args.map:
        raise OmnidError(
            f"map tags {args.source}: --tag, --tags, --rig and --map belong to a log: leave them out, "
            "or name a log instead of the map"
        )
    places, rig = read_places(args.source)
    return places.tags.known, _tags_of(places, rig), 0


def _tags_of(places: PlaceMap, rig: PlaceRig) -> dict[int, TagEstimate]:
    """Return the poses of the tags of a map, in the axes of the base at its start."""
    return {id: replace(tag, T=rig.T_base_rect @ tag.T) for id, tag in places.tags.all_located(places.poses).items()}


def _of_log(args: argparse.Namespace) -> Found:
    """Return the tags that are asked for, the poses of those that a log shows, and how many views were refused."""
    from omnid.core.places.map_tags import MapTag
    from omnid.formats.landmark_file import read_tags
    from omnid.runs.replay import ReplayOptions, run_log
    from omnid.sinks.tag_collector import TagCollector

    tags = {} if args.tags is None else read_tags(args.tags)
    tags |= {id: MapTag(id, str(id), size_m) for id, size_m in _sizes_m(args.tag).items()}
    if not tags:
        raise OmnidError(
            f"map tags {args.source}: expected --tag ID=SIZE for each tag that a log shows, such as "
            "--tag 5=0.16, or --tags TAGS.toml, or a map FILE.omap"
        )
    config = settings_of(args)
    collectors: list[TagCollector] = []  # one, which the run makes once it knows its rig

    def observer(front_end: FrontEnd, _: Telemetry) -> TagCollector:
        collectors.append(TagCollector(front_end.geometry, {id: tag.size_m for id, tag in tags.items()}))
        return collectors[-1]

    result = run_log(args.source, config, ReplayOptions(rig=args.rig, settings=args.config, observer=observer))
    for warning in result.warnings:
        print(f"omnid: warning: {warning}", file=sys.stderr)
    seen = collectors[-1]
    return tags, seen.tags(), seen.refused


def _row(tag: MapTag, found: TagEstimate) -> dict[str, Any]:
    """Return a tag as a row for the user."""
    import numpy as np

    from calib import se3

    return {
        "id": tag.id,
        "name": tag.name,
        "size_m": tag.size_m,
        "xyz_m": found.T[:3, 3].tolist(),
        "quaternion_xyzw": se3.quaternion(found.T[:3, :3]).tolist(),
        "sigma_m": float(np.sqrt(np.trace(found.covariance[:3, :3]) / 3)),
        "sigma_deg": float(np.degrees(np.sqrt(np.trace(found.covariance[3:, 3:]) / 3))),
        "views": found.views,
        "rejected": found.rejected,
    }


@command(
    option("map", type=Path, metavar="FILE.omap"),
    option(
        "--seen",
        type=Path,
        metavar="TAGS.toml",
        help="the tags in the map, as written by `omnid map "
        "tags LOG --map FILE.omap --localize-only --write TAGS.toml`; default: those of the map",
    ),
    option(
        "--known",
        type=Path,
        required=True,
        metavar="PLAN.toml",
        help="the same tags on the plan: x, "
        "y, z, and the direction that they face; omnid/formats/landmark_file.py shows one",
    ),
    option("-o", "--output", type=Path, required=True, metavar="OUT.omap"),
    REPLACE,
    examples=("map align place.omap --known plan.toml -o building.omap",),
)
def align(args: argparse.Namespace) -> int:
    """Write the map in the axes of the plan."""
    from omnid.core.places.alignment import align as align_map
    from omnid.core.places.alignment import fit, landmark
    from omnid.formats.landmark_file import read_landmarks
    from omnid.formats.place_file import read_places, write_places
    from omnid.sinks.files import check_outputs

    given = [] if args.seen is None else [("--seen", args.seen)]
    check_outputs([("-o", args.output)], [*given, ("--known", args.known)])
    require_replace("map align", args, [args.map])
    known = read_landmarks(args.known)
    places, rig = read_places(args.map)
    if args.seen is not None:
        seen, source = read_landmarks(args.seen), args.seen
    else:
        seen = {id: landmark(id, places.tags.known[id].size_m, tag.T) for id, tag in _tags_of(places, rig).items()}
        source = args.map
    try:
        T_plan_map, left_m = fit(seen, known)
    except ValueError as error:
        raise OmnidError(
            f"map align: {source} and {args.known} have {len(seen.keys() & known.keys())} tags in common: {error}"
        ) from None
    worst = max(left_m, key=lambda id: left_m[id])
    if left_m[worst] > LARGEST_M:
        raise OmnidError(
            f"map align: tag {worst} ({known[worst].name}) is {left_m[worst]:.2f} m from its place on the "
            f"plan, expected at most {LARGEST_M} m: correct its place in {args.known}, or leave it out"
        )
    align_map(places, rig, T_plan_map)
    write_places(args.output, places, rig)
    for id, metres in left_m.items():
        print(f"tag {id} ({known[id].name}): {1e3 * metres:.0f} mm from its place on the plan")
    return 0


def _sizes_m(words: list[str]) -> dict[int, float]:
    """Return the sizes of "5=0.2" by their tags. Raises OmnidError."""
    from omnid.core.places.tags import MAX_TAG, SIZES_M

    sizes: dict[int, float] = {}
    for word in words:
        id, _, size = word.partition("=")
        try:
            sizes[int(id)] = float(size)
        except ValueError:
            raise OmnidError(f"--tag {word}: expected ID=SIZE, such as 5=0.16") from None
        if not (0 <= int(id) <= MAX_TAG and SIZES_M[0] <= sizes[int(id)] <= SIZES_M[1]):
            raise OmnidError(
                f"--tag {word}: expected a number of 0 to {MAX_TAG} and an edge of {SIZES_M[0]:g} to {SIZES_M[1]:g} m"
            )
    return sizes


def _tag_lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield (
        f"{'tag':>4}  {'name':<16}{'x, m':>10}{'y, m':>10}{'z, m':>10}{'sigma, mm':>11}{'deg':>7}{'views':>7}"
        f"{'rejected':>10}"
    )
    for row in rows:
        x, y, z = row["xyz_m"]
        yield (
            f"{row['id']:>4}  {row['name']:<16}{x:>10.3f}{y:>10.3f}{z:>10.3f}"
            f"{1e3 * row['sigma_m']:>11.1f}{row['sigma_deg']:>7.2f}{row['views']:>7}{row['rejected']:>10}"
        )
