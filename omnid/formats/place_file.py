"""Map files (.omap): a map of places as an SQLite database; the format is described in OMAP.md.

A map is written to a temporary file in the same folder, synced and renamed, so that a program that is killed leaves the
old map whole. What is read is checked: the schema by its text, each row by its checksum, each value by its range.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from stat import S_ISFIFO
from typing import Final

import numpy as np

from drivers.bounded_sqlite import bound_work, open_bounded
from omnid.core.places.code_index import INDEXED, CodeIndex
from omnid.core.places.map_tags import MAX_VIEWS, TagView
from omnid.core.places.place_features import FeatureStore, PlaceFeatures, StoredFeatures
from omnid.core.places.place_map import UNUSED, Link, PlaceMap, StoredPlaces
from omnid.core.places.place_rig import PlaceRig
from omnid.core.places.tags import MAX_TAG
from omnid.errors import OmnidError
from omnid.formats import place_rows
from omnid.formats.place_rows import KeyframeRow
from omnid.formats.place_values import BadRowError, require_covariances, require_rigid
from omnid.formats.stored_features import FeatureFile
from omnid.formats.whole_file import replacement

VERSION: Final = 6  # to be raised where thumbnails or features of a place are computed otherwise: old maps fit no more
APPLICATION_ID: Final = 0x6F6D6170  # "omap", in the header of the database
# Earlier versions that are read as well. Scans before version 4 had heights above the base, not above the floor, and
# passed over low obstacles before a wall: they are read as unknown. Before version 6 floor was not seen: none is free.
WITHOUT_TAGS: Final = 2
WITHOUT_FLOOR: Final = 3
WITHOUT_CODES: Final = 4  # Features are in the rows of the keyframes, which are read whole.
WITHOUT_FREE: Final = 5
MAGIC: Final = b"SQLite format 3\0"
MAX_FILE_BYTES: Final = 1 << 30
MAX_VALUE_BYTES: Final = 1 << 20  # Limit of one value in the database.
MAX_KEYFRAMES: Final = 100_000
MAX_LINKS: Final = 1_000_000
MAX_TAG_VIEWS: Final = 100_000
LEAST_VARIANCE: Final = 1e-16  # Least variance of a loop in any direction, so that its covariance can be inverted.
MAX_INSTRUCTIONS: Final = 50_000_000  # Instructions that SQLite may take to read a map.
SCHEMA: Final = {
    "keyframe": "CREATE TABLE keyframe (id INTEGER PRIMARY KEY, session INTEGER, stamp_ns INTEGER, found INTEGER, "
    "missed INTEGER, T_map_rect BLOB, "
    "T_odom_rect BLOB, covariance BLOB, thumbnail BLOB, scan BLOB, free_m BLOB, features INTEGER, codes BLOB, "
    "azimuths BLOB, crc32 INTEGER)",
    "link": "CREATE TABLE link (a INTEGER, b INTEGER, inliers INTEGER, T_a_b BLOB, covariance BLOB, crc32 INTEGER)",
    "map": "CREATE TABLE map (keyframes INTEGER, links INTEGER, dropped INTEGER, tags INTEGER, tag_views INTEGER, "
    "width INTEGER, height INTEGER, "
    "row0 REAL, baseline_m REAL, T_rig_rect BLOB, T_base_rig BLOB, rig_hash TEXT, crc32 INTEGER)",
    "tag": "CREATE TABLE tag (id INTEGER PRIMARY KEY, name TEXT, size_m REAL, crc32 INTEGER)",
    "tag_view": "CREATE TABLE tag_view (keyframe INTEGER, tag INTEGER, T_rect_tag BLOB, covariance BLOB, "
    "crc32 INTEGER)",
    # The last table, so that what is read at the start lies together in the file.
    "features": "CREATE TABLE features (id INTEGER PRIMARY KEY, descriptors BLOB, views BLOB, crc32 INTEGER)",
}
SCHEMA_5: Final = {**SCHEMA, "keyframe": SCHEMA["keyframe"].replace("free_m BLOB, ", "")}
SCHEMA_4: Final = {
    "keyframe": SCHEMA_5["keyframe"].replace(
        "features INTEGER, codes BLOB, azimuths BLOB", "descriptors BLOB, views BLOB"
    ),
    **{table: text for table, text in SCHEMA.items() if table not in ("keyframe", "features")},
}
SCHEMA_2: Final = {
    "keyframe": SCHEMA_4["keyframe"],
    "link": SCHEMA["link"],
    "map": SCHEMA["map"].replace("tags INTEGER, tag_views INTEGER, ", ""),
}
SCHEMAS: Final = {
    WITHOUT_TAGS: SCHEMA_2,
    WITHOUT_FLOOR: SCHEMA_4,
    WITHOUT_CODES: SCHEMA_4,
    WITHOUT_FREE: SCHEMA_5,
    VERSION: SCHEMA,
}
IN_MEMORY: Final = 1 << 62  # More bytes than the features of any map have.
BLOCK: Final = 1000  # Rows of which arrays are made at once: 5 MB of keyframes; by judgement, not measured.


def write_places(path: str | Path, places: PlaceMap, rig: PlaceRig) -> None:
    """Write a map; the file is replaced at once, never written in part, by one that can be read.

    Raises OmnidError if that is impossible.
    """
    path = Path(path)
    try:
        with replacement(path) as partial:
            _write(partial, places, rig)
            _require_readable(partial)  # no map is replaced by one that would be refused
    except (OSError, ValueError, sqlite3.Error) as error:
        raise OmnidError(f"{path}: cannot write the map: {error}: choose another file") from error


def read_places(
    path: str | Path, into: PlaceMap | None = None, most_feature_bytes: int = IN_MEMORY
) -> tuple[PlaceMap, PlaceRig]:
    """Return the map of a file and the rig by which it was made.

    into: an empty map that is filled, whose bounds hold as soon as a keyframe is added to it.
    most_feature_bytes: features that take more stay in the file until they are needed.
    Raises OmnidError, in one line, for any file that is no whole map; features that stay are checked later.
    """
    path, places = Path(path), PlaceMap() if into is None else into
    version = _version_of(path)
    try:
        with ExitStack() as open_file:
            database = open_file.enter_context(closing(open_bounded(path, MAX_VALUE_BYTES, unchanging=True)))
            rig = _read(_Reader(database, version), places, most_feature_bytes)
            if places.stored is not None:
                open_file.pop_all()  # features are read from it later
        return places, rig
    except BadRowError as error:
        raise OmnidError(
            f"{path}: {error}: the map is damaged; take a copy, or build it again with `omnid map build`"
        ) from error
    except (sqlite3.Error, OverflowError, MemoryError, UnicodeDecodeError) as error:
        raise OmnidError(
            f"{path}: the map is damaged: {' '.join(str(error).split())}; take a copy, or build it again "
            "with `omnid map build`"
        ) from error


def _version_of(path: Path) -> int:
    """Return the version in the header, once it is that of an SQLite database, ours, of a version that is read."""
    try:
        status = path.stat()
        size = status.st_size
        if S_ISFIFO(status.st_mode):
            raise OmnidError(f"{path}: expected a map of places (.omap), found a pipe: name a file")
        with path.open("rb") as file:
            header = file.read(100)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise OmnidError(f"{path}: cannot read the map: {getattr(error, 'strerror', None) or error}") from error
    if len(header) < 100 or not header.startswith(MAGIC) or int.from_bytes(header[68:72]) != APPLICATION_ID:
        raise OmnidError(f"{path}: expected a map of places (.omap), found another file; `omnid map build` makes one")
    version = int.from_bytes(header[60:64])
    if version not in SCHEMAS:
        raise OmnidError(
            f"{path}: this is a map of version {version}, expected {VERSION}: build it again with "
            "`omnid map build`, or update omnid"
        )
    if size > MAX_FILE_BYTES:
        raise OmnidError(f"{path}: expected a map of at most {MAX_FILE_BYTES >> 20} MB, found {size >> 20} MB")
    return version


def _write(path: Path, places: PlaceMap, rig: PlaceRig) -> None:
    """Write the database; the same map gives the same bytes."""
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        # Not synced here, and without a journal: the file has another name until it is whole.
        for setting in (
            "journal_mode = OFF",
            "synchronous = OFF",
            f"application_id = {APPLICATION_ID}",
            f"user_version = {VERSION}",
        ):
            database.execute(f"PRAGMA {setting}")
        database.execute("BEGIN")
        for text in SCHEMA.values():
            database.execute(text)
        ids = sorted(places.keyframes)
        keyframes = (
            place_rows.keyframe_row(
                places.keyframes[id], places.poses[id], places.uses.get(id, UNUSED), rig.cylinder.width
            )
            for id in ids
        )
        _insert(database, "keyframe", keyframes)
        _insert(database, "link", (place_rows.link_row(link) for link in places.links))
        _insert(database, "tag", (place_rows.tag_row(places.tags.known[id]) for id in sorted(places.tags.known)))
        _insert(database, "tag_view", (place_rows.tag_view_row(view) for view in places.tags.views))
        _insert(database, "map", [place_rows.map_row(rig, places)])
        _insert(database, "features", (place_rows.features_row(places.keyframes[id]) for id in ids))
        database.execute("COMMIT")


def _insert(database: sqlite3.Connection, table: str, rows: Iterable[place_rows.Row]) -> None:
    """Insert rows, each with its checksum as the last value."""
    marks = ", ".join("?" * (SCHEMA[table].count(",") + 1))
    database.executemany(f"INSERT INTO {table} VALUES ({marks})", ((*row, place_rows.checksum(row)) for row in rows))


class _Reader:
    """Rows of a database that may be hostile: bounded work, no code of the file, checked sums."""

    def __init__(self, database: sqlite3.Connection, version: int) -> None:
        self.database, self.version = database, version
        schema = SCHEMAS[version]
        bound_work(database, MAX_INSTRUCTIONS)
        found = dict(database.execute("SELECT name, sql FROM sqlite_schema").fetchmany(len(schema) + 1))
        if found != schema:
            raise BadRowError("its tables are not those of a map")

    def rows(self, table: str, most: int) -> Iterator[place_rows.Row]:
        """Yield the rows of a table without their checksums, at most the given number."""
        for number, row in enumerate(self.database.execute(f"SELECT * FROM {table} ORDER BY rowid")):
            if number >= most:
                raise BadRowError(f"more than {most} rows of {table}")
            if place_rows.checksum(row[:-1]) != row[-1]:
                raise BadRowError(f"the checksum of row {number + 1} of {table} is wrong")
            yield row[:-1]

    def blocks(self, table: str, most: int) -> Iterator[list[place_rows.Row]]:
        """Yield the same rows, BLOCK at a time."""
        rows = self.rows(table, most)
        while block := list(islice(rows, BLOCK)):
            yield block


def _read(reader: _Reader, places: PlaceMap, most_feature_bytes: int) -> PlaceRig:
    """Fill an empty map; return the rig."""
    heads = list(reader.rows("map", 1))
    if not heads:
        raise BadRowError("the table map is empty")
    has_tags = reader.version != WITHOUT_TAGS
    head = place_rows.read_map_row(heads[0] if has_tags else place_rows.head_of_version_2(heads[0]))
    keyframes, features = _read_keyframes(reader, head.rig, places, most_feature_bytes)
    links = [link for block in reader.blocks("link", MAX_LINKS) for link in place_rows.read_links(block)]
    tags = [place_rows.read_tag_row(row) for row in reader.rows("tag", MAX_TAG + 1)] if has_tags else []
    views = [place_rows.read_tag_view_row(row) for row in reader.rows("tag_view", MAX_TAG_VIEWS)] if has_tags else []
    for name, found, expected in (
        ("keyframes", len(keyframes), head.keyframes),
        ("links", len(links), head.links),
        ("tags", len(tags), head.tags),
        ("views of tags", len(views), head.tag_views),
    ):
        if found != expected:
            raise BadRowError(f"expected {expected} {name}, found {found}")
    _check(keyframes, links)
    for row, of_row in zip(keyframes, features, strict=True):
        if reader.version <= WITHOUT_FLOOR:
            row.scan.fill(np.nan)
        places.keyframes[row.id], places.poses[row.id] = row.keyframe(of_row), row.T_map_rect
        if row.use != UNUSED:
            places.uses[row.id] = row.use
    places.links, places.dropped = links, head.dropped
    _check_views(views, {tag.id for tag in tags}, places.keyframes.keys())
    places.tags.known = {tag.id: tag for tag in tags}
    places.tags.views = views
    return head.rig


def _read_keyframes(
    reader: _Reader, rig: PlaceRig, places: PlaceMap, most_feature_bytes: int
) -> tuple[list[KeyframeRow], Sequence[PlaceFeatures | StoredFeatures]]:
    """Return the keyframes and their features; where these stay in the file, the map gets the index of them."""
    keyframes: list[KeyframeRow] = []
    features: list[PlaceFeatures] = []
    codes: list[place_rows.KeyframeCodes] = []
    has_codes = reader.version > WITHOUT_CODES
    for block in reader.blocks("keyframe", MAX_KEYFRAMES):
        if reader.version <= WITHOUT_FREE:
            block = [place_rows.keyframe_without_free(row) for row in block]
        keyframes += place_rows.read_keyframes(block)
        if has_codes:
            codes.append(place_rows.read_codes(block))
        else:
            features += [place_rows.read_features(row[-2], row[-1], rig) for row in block]
    if not has_codes:
        return keyframes, features
    counts = [count for block in codes for count in block.counts]
    if sum(counts) * place_rows.FEATURE_BYTES > most_feature_bytes:
        store = FeatureStore(FeatureFile(reader.database, rig).read, most_feature_bytes)
        places.stored = StoredPlaces(_index([row.id for row in keyframes], counts, codes), store)
        return keyframes, [StoredFeatures(row.id, n, store) for row, n in zip(keyframes, counts, strict=True)]
    by_id = {
        id: place_rows.read_features(descriptors, views, rig)
        for id, descriptors, views in reader.rows("features", MAX_KEYFRAMES)
    }
    if [(id, one.count) for id, one in by_id.items()] != list(zip([row.id for row in keyframes], counts, strict=True)):
        raise BadRowError(f"the features are not those of {len(keyframes)} keyframes")
    return keyframes, list(by_id.values())


def _index(ids: list[int], counts: list[int], codes: list[place_rows.KeyframeCodes]) -> CodeIndex:
    """Return the index of keyframes, from blocks of their codes."""
    return CodeIndex(
        np.array(ids, np.int64),
        np.minimum(counts, INDEXED),
        np.concatenate([block.codes for block in codes]),
        np.concatenate([block.azimuths for block in codes]),
    )


def _require_readable(path: Path) -> None:
    """Read a map and check all of it, keyframe after keyframe, so that a large one needs little memory."""
    places, _ = read_places(path, most_feature_bytes=0)
    for keyframe in places.keyframes.values():
        if keyframe.features.copied().count != keyframe.features.count:
            raise BadRowError(f"the features of keyframe {keyframe.id} are outside their range")


def _check_views(views: list[TagView], tags: Set[int], keyframes: Set[int]) -> None:
    """Check poses and covariances of views, and that they are of tags and keyframes of the map."""
    if any(view.tag not in tags or view.keyframe not in keyframes for view in views):
        raise BadRowError("a view of a tag is of no tag, or of no keyframe")
    if any(count > MAX_VIEWS for count in Counter(view.tag for view in views).values()):
        raise BadRowError(f"a tag has more than {MAX_VIEWS} views")
    require_rigid([view.T_rect_tag for view in views])
    require_covariances([view.covariance for view in views], LEAST_VARIANCE)


def _check(keyframes: list[KeyframeRow], links: list[Link]) -> None:
    """Check poses and covariances, all at once, and that links join keyframes."""
    ids = {keyframe.id for keyframe in keyframes}
    if any(link.a not in ids or link.b not in ids or link.a == link.b for link in links):
        raise BadRowError("a link joins no two keyframes")
    require_rigid([k.T_map_rect for k in keyframes])
    require_rigid([k.T_odom_rect for k in keyframes])
    require_rigid([link.T_a_b for link in links])
    require_covariances([k.covariance for k in keyframes], 0.0)
    require_covariances([link.covariance for link in links if not link.is_loop], 0.0)
    require_covariances([link.covariance for link in links if link.is_loop], LEAST_VARIANCE)
