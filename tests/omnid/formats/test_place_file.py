"""Map files: round trip, size, the same bytes, atomic writing, damaged, foreign and hostile files."""

from __future__ import annotations

import dataclasses
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from omnid.core.places.place_map import UNUSED, PlaceMap
from omnid.errors import OmnidError
from omnid.formats.place_file import (
    APPLICATION_ID,
    MAX_VALUE_BYTES,
    SCHEMA_2,
    SCHEMA_4,
    SCHEMA_5,
    read_places,
    write_places,
)
from omnid.formats.place_rows import checksum, features_row, keyframe_row
from omnid.formats.ply import write_ply
from tests.bench.faults.mutation import mutated
from tests.omnid.formats.place_maps import RIG, some_places
from tests.omnid.formats.test_ply import some_points


def same(a: object, b: object) -> bool:
    """True if two values, dataclasses or arrays are equal to the last bit."""
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    return a == b


@pytest.mark.parametrize("count", [0, 1, 25])
def test_reads_what_was_written(tmp_path: Path, count: int) -> None:
    places = some_places(count)
    write_places(tmp_path / "a.omap", places, RIG)
    read, rig = read_places(tmp_path / "a.omap")
    assert same(rig, RIG) and read.dropped == places.dropped and read.uses == places.uses
    assert list(read.keyframes) == list(places.keyframes)
    assert all(same(read.keyframes[id], places.keyframes[id]) for id in places.keyframes)
    assert all(same(read.poses[id], places.poses[id]) for id in places.keyframes)
    assert len(read.links) == len(places.links)
    assert all(same(a, b) for a, b in zip(read.links, places.links, strict=True))
    assert read.tags.known == places.tags.known
    assert all(same(a, b) for a, b in zip(read.tags.views, places.tags.views, strict=True))


def test_a_map_of_the_version_before_is_read(tmp_path: Path) -> None:
    """It had no tags; its row of the map has another checksum."""
    path, places = tmp_path / "a.omap", some_places(4)
    write_places(path, places, RIG)
    row = head_of(path)
    row = (*row[:3], *row[5:-1])
    changed(
        as_of_version_4(path, places),
        "DROP TABLE tag",
        "DROP TABLE tag_view",
        "DROP TABLE map",
        SCHEMA_2["map"],
        "PRAGMA user_version = 2",
    )
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"INSERT INTO map VALUES ({', '.join('?' * 11)})", (*row, checksum(row)))
        database.commit()
    read, rig = read_places(path)
    assert same(rig, RIG) and same(read.poses[2], places.poses[2]) and not read.tags.known
    write_places(path, read, rig)
    assert len(read_places(path)[0]) == 4


def test_scans_of_versions_before_heights_above_the_floor_are_unknown(tmp_path: Path) -> None:
    path, places = tmp_path / "a.omap", some_places(4)
    write_places(path, places, RIG)
    assert np.isfinite(read_places(path)[0].keyframes[2].scan).any()
    changed(as_of_version_4(path, places), "PRAGMA user_version = 3")
    read = read_places(path)[0]
    assert len(read) == 4 and all(np.isnan(keyframe.scan).all() for keyframe in read.keyframes.values())


def test_version_4_had_the_features_in_the_rows_of_the_keyframes(tmp_path: Path) -> None:
    """They are read whole, however many there are, and the map is written in the version of today."""
    path, places = tmp_path / "a.omap", some_places(4)
    write_places(path, places, RIG)
    now = path.read_bytes()
    read, rig = read_places(as_of_version_4(path, places), most_feature_bytes=0)
    assert read.stored is None
    for id, keyframe in read.keyframes.items():
        assert not keyframe.free_m.any()
        read.keyframes[id] = dataclasses.replace(keyframe, free_m=places.keyframes[id].free_m)
        assert same(read.keyframes[id], places.keyframes[id])
    write_places(path, read, rig)
    assert path.read_bytes() == now


def test_nothing_is_free_in_a_map_of_version_5(tmp_path: Path) -> None:
    """It says where ranges were seen, but not where floor was."""
    path, places = tmp_path / "a.omap", some_places(4)
    write_places(path, places, RIG)
    with closing(sqlite3.connect(path)) as database:
        rows = [(*row[:10], *row[11:-1]) for row in database.execute("SELECT * FROM keyframe ORDER BY id")]
    changed(path, "DROP TABLE keyframe", SCHEMA_5["keyframe"], "PRAGMA user_version = 5")
    with closing(sqlite3.connect(path)) as database:
        for row in rows:
            database.execute(f"INSERT INTO keyframe VALUES ({', '.join('?' * 14)})", (*row, checksum(row)))
        database.commit()
    read, _ = read_places(path)
    for id, keyframe in read.keyframes.items():
        assert not keyframe.free_m.any() and same(keyframe.scan, places.keyframes[id].scan)
        assert same(keyframe.features.copied(), places.keyframes[id].features)


def as_of_version_4(path: Path, places: PlaceMap) -> Path:
    """Change a file to one of version 4."""
    changed(path, "DROP TABLE features", "DROP TABLE keyframe", SCHEMA_4["keyframe"], "PRAGMA user_version = 4")
    with closing(sqlite3.connect(path)) as database:
        for id in sorted(places.keyframes):
            keyframe, use = places.keyframes[id], places.uses.get(id, UNUSED)
            row = keyframe_row(keyframe, places.poses[id], use, RIG.cylinder.width)[:10]
            row = (*row, *features_row(keyframe)[1:])
            database.execute(f"INSERT INTO keyframe VALUES ({', '.join('?' * 13)})", (*row, checksum(row)))
        database.commit()
    return path


def head_of(path: Path) -> tuple[object, ...]:
    """The row of the table map."""
    with closing(sqlite3.connect(path)) as database:
        return tuple(database.execute("SELECT * FROM map").fetchone())


@pytest.mark.parametrize(
    ("view", "tag", "message"),
    [
        ({"tag": 7}, {}, "a view of a tag is of no tag"),
        ({"keyframe": 99}, {}, "a view of a tag is of no tag, or of no keyframe"),
        ({"T_rect_tag": np.diag([-1.0, 1, 1, 1])}, {}, "a pose is no rotation"),
        ({"covariance": np.zeros((6, 6))}, {}, "a covariance is not positive"),
        ({}, {"name": "a\nb"}, "the name of a tag is none"),
        ({}, {"name": "x" * 65}, "the name of a tag is none"),
        ({}, {"size_m": 20.0}, "outside its range"),
        ({}, {"id": 587}, "outside its range"),
    ],
)
def test_tags_outside_their_range_are_not_written(
    tmp_path: Path, view: dict[str, object], tag: dict[str, object], message: str
) -> None:
    places = some_places(3)
    places.tags.views[1] = dataclasses.replace(places.tags.views[1], **view)
    places.tags.known[5] = dataclasses.replace(places.tags.known[5], **tag)
    with pytest.raises(OmnidError, match=message):
        write_places(tmp_path / "a.omap", places, RIG)


def test_a_keyframe_takes_less_than_50_kb_and_the_same_map_has_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_places(tmp_path / f"{name}.omap", some_places(40), RIG)
    content = (tmp_path / "a.omap").read_bytes()
    assert len(content) < 40 * 50_000
    assert content == (tmp_path / "b.omap").read_bytes()


def test_the_bounds_of_the_map_that_is_filled_hold(tmp_path: Path) -> None:
    write_places(tmp_path / "a.omap", some_places(10), RIG)
    places, _ = read_places(tmp_path / "a.omap", PlaceMap(max_keyframes=5))
    assert len(places) == 10
    places.add(dataclasses.replace(places.keyframes[0], id=10), np.eye(4))
    assert len(places) == 5


def test_any_mutation_of_a_map_is_a_map_or_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.omap"
    write_places(path, some_places(4, features=8), RIG)
    good, refused = path.read_bytes(), 0
    for number in range(400):
        path.write_bytes(mutated(random.Random(f"omap {number}"), good))
        try:
            read_places(path)
        except OmnidError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).startswith(str(path))
    assert refused > 200


@pytest.mark.parametrize("size", [0, 15, 99, 100, 4096, -1])
def test_a_cut_map_is_refused(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.omap"
    write_places(path, some_places(4), RIG)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(OmnidError, match=r"a\.omap: "):
        read_places(path)


def test_a_pipe_without_a_writer_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "place.omap")
    with pytest.raises(OmnidError, match=r"expected a map of places \(\.omap\), found a pipe: name a file"):
        read_places(tmp_path / "place.omap")


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    write_ply(tmp_path / "map.ply", some_points(1000))
    other = sqlite3.connect(tmp_path / "other.db")
    other.execute("CREATE TABLE keyframe (id INTEGER)")
    other.close()
    for path in (tmp_path / "map.ply", tmp_path / "other.db"):
        with pytest.raises(OmnidError, match="expected a map of places"):
            read_places(path)
    for path in (tmp_path / "missing.omap", tmp_path, tmp_path / "a\0b"):
        with pytest.raises(OmnidError, match="cannot read the map"):
            read_places(path)


def changed(path: Path, *statements: str) -> Path:
    """Change a map by SQL."""
    database = sqlite3.connect(path)
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()
    return path


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("PRAGMA user_version = 1", "version 1, expected 6"),
        ("UPDATE keyframe SET stamp_ns = 5 WHERE id = 2", "the checksum of row 3 of keyframe"),
        ("UPDATE link SET inliers = 5", "the checksum of row 1 of link"),
        ("DELETE FROM keyframe WHERE id = 3", "the features are not those of 3 keyframes"),
        ("DELETE FROM features WHERE id = 3", "the features are not those of 4 keyframes"),
        ("UPDATE features SET views = zeroblob(0) WHERE id = 1", "the checksum of row 2 of features"),
        ("DELETE FROM link WHERE rowid = 1", "expected 4 links, found 3"),
        ("DELETE FROM tag WHERE id = 586", "expected 2 tags, found 1"),
        ("DELETE FROM tag_view WHERE rowid = 1", "expected 3 views of tags, found 2"),
        ("UPDATE tag SET name = 'other'", "the checksum of row 1 of tag"),
        ("PRAGMA user_version = 2", "tables are not those"),
        ("DELETE FROM map", "the table map is empty"),
        ("CREATE TRIGGER t AFTER INSERT ON link BEGIN DELETE FROM link; END", "tables are not those"),
        ("CREATE TABLE other (a)", "tables are not those"),
    ],
)
def test_a_map_that_was_changed_is_refused(tmp_path: Path, statement: str, message: str) -> None:
    write_places(tmp_path / "a.omap", some_places(4), RIG)
    with pytest.raises(OmnidError, match=message):
        read_places(changed(tmp_path / "a.omap", statement))


def test_a_view_in_the_place_of_a_table_is_not_asked(tmp_path: Path) -> None:
    path = tmp_path / "a.omap"
    endless = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x FROM n) SELECT x FROM n"
    changed(
        path,
        f"PRAGMA application_id = {APPLICATION_ID}",
        "PRAGMA user_version = 4",
        *(f"CREATE VIEW {name} AS {endless}" for name in ("keyframe", "link", "map", "tag", "tag_view")),
    )
    with pytest.raises(OmnidError, match="tables are not those"):
        read_places(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_odom_rect": np.full((4, 4), np.nan)}, "a pose is not finite"),
        ({"T_odom_rect": np.diag([2.0, 0.5, 1, 1])}, "a pose is no rotation"),
        ({"T_odom_rect": np.diag([-1.0, 1, 1, 1])}, "a pose is no rotation"),
        ({"covariance": -np.eye(6)}, "a covariance is not positive"),
        ({"covariance": np.triu(np.ones((6, 6)))}, "a covariance is not symmetric"),
        ({"covariance": np.full((6, 6), np.inf)}, "a covariance is not finite"),
        ({"scan": np.full(360, 1000, np.float16)}, "a range of a keyframe"),
        ({"free_m": np.full(360, np.nan, np.float16)}, "a range of a keyframe"),
        ({"free_m": np.full(360, -1000, np.float16)}, "a range of a keyframe"),
        ({"thumbnail": np.zeros((16, 64), np.int8)}, "an array has another size"),
        ({"session": -1}, "outside its range"),
    ],
)
def test_values_outside_their_range_are_not_written(tmp_path: Path, change: dict[str, object], message: str) -> None:
    """A map is read again before the old map is replaced, with right checksums."""
    write_places(tmp_path / "a.omap", some_places(2), RIG)
    places = some_places(3)
    places.keyframes[1] = dataclasses.replace(places.keyframes[1], **change)
    with pytest.raises(OmnidError, match=message):
        write_places(tmp_path / "a.omap", places, RIG)
    assert len(read_places(tmp_path / "a.omap")[0]) == 2 and os.listdir(tmp_path) == ["a.omap"]


def test_links_to_nowhere_and_loops_without_uncertainty_are_refused(tmp_path: Path) -> None:
    for change, message in (
        ({"b": 99}, "joins no two keyframes"),
        ({"a": 2}, "joins no two keyframes"),
        ({"covariance": np.zeros((6, 6))}, "not positive"),
    ):
        places = some_places(3)
        places.links[2] = dataclasses.replace(places.links[2], **change)
        with pytest.raises(OmnidError, match=message):
            write_places(tmp_path / "a.omap", places, RIG)


def test_odometry_that_stood_still_has_no_uncertainty(tmp_path: Path) -> None:
    places = some_places(3)
    places.links[0] = dataclasses.replace(places.links[0], covariance=np.zeros((6, 6)))
    write_places(tmp_path / "a.omap", places, RIG)
    assert len(read_places(tmp_path / "a.omap")[0].links) == 3


def test_a_map_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(OmnidError, match=r"cannot write the map: .*: choose another file$"):
        write_places(tmp_path / "no folder" / "a.omap", some_places(1), RIG)


def test_a_map_is_on_the_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a power cut could leave an empty file in the place of the map. The calls are made, and their order kept."""
    calls: list[tuple[str, str]] = []
    sync, replace = os.fsync, os.replace

    def noted_sync(number: int) -> None:
        sync(number)
        calls.append(("sync", os.readlink(f"/proc/self/fd/{number}")))

    def noted_replace(source: Path, target: Path) -> None:
        replace(source, target)
        calls.append(("replace", str(source)))

    monkeypatch.setattr(os, "fsync", noted_sync)
    monkeypatch.setattr(os, "replace", noted_replace)
    write_places(tmp_path / "a.omap", some_places(2), RIG)
    partial = calls[0][1]
    assert calls == [("sync", partial), ("replace", partial), ("sync", str(tmp_path))]
    assert Path(partial).suffix == ".part"


def test_a_value_that_is_too_long_is_never_read(tmp_path: Path) -> None:
    path = tmp_path / "a.omap"
    write_places(path, some_places(2), RIG)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE keyframe SET thumbnail = zeroblob(?)", (MAX_VALUE_BYTES + 1,))
    with pytest.raises(OmnidError, match="string or blob too big"):
        read_places(path)


def test_a_program_that_is_killed_while_it_writes_leaves_the_old_map(tmp_path: Path) -> None:
    path, old = tmp_path / "a.omap", some_places(3)
    write_places(path, old, RIG)
    before = path.read_bytes()
    code = (
        "import sys; from tests.omnid.formats.place_maps import *; from omnid.formats.place_file import *\n"
        "places = some_places(60); print('ready', flush=True)\nwhile True: write_places(sys.argv[1], places, RIG)"
    )
    rng = random.Random(1)
    for _ in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[3]
        ) as writer:
            assert writer.stdout is not None and writer.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.1))
            os.kill(writer.pid, signal.SIGKILL)
        places, _ = read_places(path)
        assert len(places) in (3, 60)
        assert len(places) == 60 or path.read_bytes() == before
    write_places(path, old, RIG)
    assert os.listdir(tmp_path) == ["a.omap"]
