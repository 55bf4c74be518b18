"""Map files: round trip, the same bytes, atomic writing; damaged, foreign and hostile files."""

from __future__ import annotations

import dataclasses
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from omnid.core.navigation.route import Route
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from omnid.formats.route_file import RouteFolder, parse_route, route_bytes
from tests.bench.faults.mutation import mutated
from tests.omnid.formats.place_maps import RIG, some_places

Arrays = dict[str, Any]


@pytest.fixture
def omap(tmp_path: Path) -> Path:
    """A map of four keyframes."""
    write_places(tmp_path / "a.omap", some_places(4), RIG)
    return tmp_path / "a.omap"


def same(a: object, b: object) -> bool:
    """True if two values, dataclasses or arrays are equal to the last bit."""
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    return a == b


@pytest.mark.parametrize("count", [0, 1, 25])
def test_a_map_is_read_as_written_and_gives_the_same_bytes(tmp_path: Path, count: int) -> None:
    places = some_places(count)
    write_places(tmp_path / "a.omap", places, RIG)
    read, rig = read_places(tmp_path / "a.omap")
    assert same(rig, RIG) and read.dropped == places.dropped
    assert list(read.keyframes) == list(places.keyframes)
    assert all(same(read.keyframes[id], places.keyframes[id]) for id in places.keyframes)
    assert all(same(read.poses[id], places.poses[id]) for id in places.keyframes)
    assert all(same(a, b) for a, b in zip(read.links, places.links, strict=True))
    write_places(tmp_path / "b.omap", read, rig)
    content = (tmp_path / "b.omap").read_bytes()
    assert content == (tmp_path / "a.omap").read_bytes() and len(content) < 10_000 + 50_000 * count


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


def test_files_that_are_no_map_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "map.ply").write_bytes(b"ply\n")
    (tmp_path / "old.omap").write_bytes(b"SQLite format 3\0" + bytes(100))
    np.savez_compressed(tmp_path / "packed.npz", views=np.zeros(10**7))
    for name in ("pipe", "map.ply", "old.omap", "packed.npz"):
        with pytest.raises(OmnidError, match=r"expected a map of places .*`omnid map build` makes one"):
            read_places(tmp_path / name)
    for name in ("missing.omap", "a\0b"):
        with pytest.raises(OmnidError, match=r"cannot read the map|expected a map"):
            read_places(tmp_path / name)


def edit(name: str, field: str, value: object, row: int = 1) -> Callable[[Arrays], None]:
    """Return a change of one value."""

    def change(arrays: Arrays) -> None:
        arrays[name][field][row] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays: arrays.pop("links"), "links"),
        (lambda arrays: arrays.update(links=arrays["links"].astype(object)), "damaged one"),
        (lambda arrays: arrays.update(keyframes=arrays["keyframes"].repeat(2)), "not in the order of their ids"),
        (lambda arrays: arrays.update(keyframes=arrays["keyframes"].reshape(2, 2)), "another type or size"),
        (lambda arrays: arrays.update(views=arrays["views"][:-1]), "descriptors has another type or size"),
        (edit("map", "format", 9, 0), "expected version"),
        (edit("map", "baseline_m", np.nan, 0), "not finite"),
        (edit("keyframes", "features", -1), "features are not those"),
        (edit("keyframes", "T_map_rect", np.nan), "not finite"),
        (edit("links", "a", 99), "joins no two keyframes"),
    ],
)
def test_a_map_that_was_changed_with_right_checksums_is_refused(
    omap: Path, change: Callable[[Arrays], None], message: str
) -> None:
    with np.load(omap) as found:
        arrays = dict(found)
    change(arrays)
    with omap.open("wb") as file:
        np.savez(file, **arrays)
    with pytest.raises(OmnidError, match=message) as refused:
        read_places(omap)
    assert "\n" not in str(refused.value)


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


# Route files: the same content back, nothing else accepted, whole or not at all


def route(name: str = "hall", points: int = 40) -> Route:
    rng = np.random.default_rng(1)
    poses = np.column_stack([np.arange(points) * 0.1, rng.normal(0, 0.01, points), rng.normal(0, 0.1, points)])
    return Route(
        name,
        poses.round(6),
        np.full(points, 0.25),
        np.arange(points) // 10,
        rng.normal(0, 0.3, (points, 3)).round(6),
        {k: 10**18 + k for k in range(4)},
        1_790_000_000,
        "a.omap",
    )


def test_a_route_comes_back(tmp_path: Path) -> None:
    folder = RouteFolder(tmp_path / "new" / "routes")
    folder.write(route())
    folder.write(route("b-2"))
    found = folder.read("hall")
    for name in ("poses", "speeds", "keyframes", "in_keyframe"):
        np.testing.assert_array_equal(getattr(found, name), getattr(route(), name))
    assert (found.name, found.created_s, found.map_name) == ("hall", 1_790_000_000, "a.omap")
    assert found.stamps_ns == route().stamps_ns
    assert folder.names() == ["b-2", "hall"]
    assert route_bytes(found) == route_bytes(route()), "the same route gives the same bytes"
    with pytest.raises(OmnidError, match=r"cannot read the route: No such file.*there: b-2, hall"):
        folder.read("other")


def test_a_name_cannot_leave_the_folder(tmp_path: Path) -> None:
    folder = RouteFolder(tmp_path)
    for name in ("../x", "/etc/passwd", "", ".x", "a/b", "a\0"):
        with pytest.raises(OmnidError, match="no name of a route"):
            folder.read(name)


def test_a_copy_under_another_name_is_refused(tmp_path: Path) -> None:
    folder = RouteFolder(tmp_path)
    folder.write(route())
    folder.path("other").write_bytes(folder.path("hall").read_bytes())
    with pytest.raises(OmnidError, match="this is the route hall"):
        folder.read("other")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "no route of version 1"),
        ({"points": []}, "length >= 2"),
        ({"points": [[1] * 7] * 2}, "length 8"),
        ({"points": [[1, 2, 3, 4, 1.5, 0, 0, 0]] * 3}, r"int.*points\[0\]\[4\]"),
        ({"keyframes": [[1, -1]]}, r"keyframes\[0\]\[1\]"),
        ({"columns": ["x_m"]}, "expected the columns"),
        ({"crc32": 1}, "checksum"),
        ({"more": 1}, "unknown field `more`"),
    ],
)
def test_a_route_that_does_not_fit_is_refused_in_one_line(change: dict[str, object], words: str) -> None:
    content = json.loads(route_bytes(route())) | change
    with pytest.raises(OmnidError, match=words) as error:
        parse_route(json.dumps(content).encode(), "r")
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


@pytest.mark.hazard("H33")
def test_damaged_files_are_refused_or_the_same_route() -> None:
    rng, good = random.Random(2), route_bytes(route())
    for _ in range(400):
        damaged = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            found = parse_route(bytes(damaged[: rng.randint(len(damaged) // 2, len(damaged))]), "r")
        except OmnidError:
            continue
        assert np.isfinite(found.poses).all()
