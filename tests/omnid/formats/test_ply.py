"""PLY maps: exact round trip, layout of the file, atomic writing, refused files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from omnid.core.mapping.voxel_map import MapPoints
from omnid.errors import OmnidError
from omnid.formats.ply import write_ply
from tests.ply import read_ply


def some_points(count: int) -> MapPoints:
    rng = np.random.default_rng(count)
    return MapPoints(
        xyz=rng.normal(0.0, 9.0, (count, 3)).astype(np.float32),
        confidence=rng.uniform(0.0, 1.0, count).astype(np.float32),
        frames=rng.integers(1, 500, count, dtype=np.int32),
        age=rng.integers(0, 500, count, dtype=np.int32),
    )


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_reads_what_was_written(tmp_path: Path, count: int) -> None:
    path, points = tmp_path / "map.ply", some_points(count)
    write_ply(path, points)
    read = read_ply(path)
    for name in ("xyz", "confidence", "frames", "age"):
        expected, found = getattr(points, name), getattr(read, name)
        assert found.dtype == expected.dtype and np.array_equal(found, expected)


def test_the_layout_agrees_with_the_header(tmp_path: Path) -> None:
    path, points = tmp_path / "map.ply", some_points(3)
    write_ply(path, points)
    header, body = path.read_bytes().split(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "element vertex 3" in lines
    types = {"float": "<f4", "int": "<i4"}
    fields = [(line.split()[2], types[line.split()[1]]) for line in lines if line.startswith("property")]
    vertices = np.frombuffer(body, dtype=fields)
    assert [name for name, _ in fields] == ["x", "y", "z", "confidence", "frames", "age"]
    assert np.array_equal(vertices["y"], points.xyz[:, 1]) and np.array_equal(vertices["age"], points.age)


def test_a_reader_keeps_the_old_map_while_a_new_one_is_written(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, some_points(5))
    with path.open("rb") as reader:
        old = path.read_bytes()
        write_ply(path, some_points(900))
        assert reader.read() == old


def test_refuses_paths_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name in ("absent/map.ply", "file/map.ply", "folder", "nul\0.ply", "x" * 300):
        with pytest.raises(OmnidError, match="cannot write"):
            write_ply(tmp_path / name, some_points(1))
    with pytest.raises(OmnidError):
        write_ply("/", some_points(1))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
