"""Route files: the same content back, nothing else accepted, whole or not at all."""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest

from omnid.core.navigation.route import Route
from omnid.errors import OmnidError
from omnid.formats.route_file import MAX_BYTES, RouteFolder, parse_route, route_bytes


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
    folder.delete("hall")
    assert folder.names() == ["b-2"]
    with pytest.raises(OmnidError, match=r"no route hall in .*: there are: b-2"):
        folder.read("hall")
    with pytest.raises(OmnidError, match="nothing was deleted"):
        folder.delete("hall")


def test_a_name_cannot_leave_the_folder(tmp_path: Path) -> None:
    folder = RouteFolder(tmp_path)
    for name in ("../x", "/etc/passwd", "", ".x", "a/b", "a\0"):
        with pytest.raises(OmnidError, match="no name of a route"):
            folder.read(name)
        with pytest.raises(OmnidError, match="no name of a route"):
            folder.delete(name)


def test_a_copy_under_another_name_is_refused(tmp_path: Path) -> None:
    folder = RouteFolder(tmp_path)
    folder.write(route())
    folder.path("other").write_bytes(folder.path("hall").read_bytes())
    with pytest.raises(OmnidError, match="this is the route hall"):
        folder.read("other")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "version 2, expected 1"),
        ({"points": []}, "length >= 2"),
        ({"points": [[1] * 8] * 2}, "checksum"),
        ({"points": [[1] * 7] * 2}, "length 8"),
        ({"points": [[1, 2, 3, 4, 1.5, 0, 0, 0]] * 3}, r"int.*points\[0\]\[4\]"),
        ({"points": [[0, 0, 0, 21.0, 1, 0, 0, 0]] * 2}, r"20.*points\[0\]\[3\]"),
        ({"keyframes": [[1, -1]]}, r"keyframes\[0\]\[1\]"),
        ({"columns": ["x_m"]}, "expected the columns"),
        ({"crc32": 1}, "checksum"),
        ({"more": 1}, "unknown field `more`"),
        ({"created_s": -1}, "created_s"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(change: dict[str, object], words: str) -> None:
    content = json.loads(route_bytes(route())) | change
    with pytest.raises(OmnidError, match=words) as error:
        parse_route(json.dumps(content).encode(), "r")
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 50,
        b"[" * 100_000,
        b'{"format":"omnid route"',
        b"\xff\xfe",
        b'{"format":"omnid route","version":1}',
        b" " * (MAX_BYTES + 1),
        b'{"format": "omnid route", "version": NaN}',
    ],
)
def test_other_bytes_are_refused(content: bytes) -> None:
    with pytest.raises(OmnidError):
        parse_route(content, "r")


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
