"""Typed look-ups in the tables of files: what was expected, what was found, and where."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.validation import MAX_SIDE_PX, ValidatedTable, is_image_size, read_bytes, require_schema, rigid, toml_table

TABLE = ValidatedTable(
    {
        "a": "text",
        "n": 2,
        "list": [1, 2.5],
        "size": [640, 480],
        "t": {"deep": 1},
        "ts": [{"x": 1}, {"x": 2}],
        "p": [[1, 2]],
    },
    "file.toml",
    "top",
)


def test_values_are_returned_with_their_types() -> None:
    assert (TABLE.text("a"), TABLE.number("n"), TABLE.numbers("list"), TABLE.size("size")) == (
        "text",
        2.0,
        (1.0, 2.5),
        (640, 480),
    )
    assert TABLE.table("t").number("deep") == 1 and [one.number("x") for one in TABLE.tables("ts", 2)] == [1, 2]
    assert (
        TABLE.points("p", 1, 3) == [(1.0, 2.0)]
        and TABLE.tables("missing", 2) == []
        and TABLE.choice("a", ("text",)) == "text"
    )


@pytest.mark.parametrize(
    ("look_up", "message"),
    [
        (lambda table: table.number("a"), "top.a: expected a finite number, found 'text'"),
        (lambda table: table.number("missing"), "top.missing: expected a finite number, found nothing"),
        (lambda table: table.text("n"), "top.n: expected a string, found 2"),
        (lambda table: table.choice("a", ("x", "y")), "top.a: expected x or y"),
        (lambda table: table.numbers("list", 3), "top.list: expected 3 finite numbers"),
        (lambda table: table.size("list"), f"1 to {MAX_SIDE_PX}"),
        (lambda table: table.table("n"), "top.n: expected a table"),
        (lambda table: table.tables("ts", 1), r"at most 1 tables \[\[top.ts\]\]"),
        (lambda table: table.points("p", 2, 3), r"2 to 3 points \[x, y\]"),
        (lambda table: table.table("t").text("deep"), "top.t.deep: expected a string"),
        (lambda table: table.tables("ts", 2)[1].text("x"), r"top.ts\[1\].x: expected a string"),
        (lambda table: table.allow_only(("a", "n")), "top.list: unknown key, expected one of a, n"),
    ],
)
def test_a_wrong_value_is_named_with_its_file_and_its_key(
    look_up: Callable[[ValidatedTable], object], message: str
) -> None:
    with pytest.raises(CalibError, match=f"^file.toml: .*{message}") as caught:
        look_up(TABLE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [True, 1e301, float("nan"), float("inf"), "1"])
def test_numbers_are_finite(value: object) -> None:
    with pytest.raises(CalibError, match="a finite number"):
        ValidatedTable({"a": value}, "f").number("a")


def test_a_transform_is_rigid_and_its_rotation_is_made_orthonormal() -> None:
    T = se3.transform(se3.rotation_exp([0.1, 0.2, 0.3]), [1, 2, 3])
    assert rigid(T) is T
    rounded = ValidatedTable({"T": T.round(5).tolist()}, "f").transform("T")
    assert np.abs(rounded[:3, :3] @ rounded[:3, :3].T - np.eye(3)).max() < 1e-12 and np.allclose(rounded, T, atol=1e-4)
    for wrong in (np.eye(4) * 2, np.diag([1.0, 1, -1, 1]), np.eye(3)):
        with pytest.raises(CalibError, match=r"expected (a rotation|4 rows)"):
            ValidatedTable({"T": wrong.tolist()}, "f").transform("T")


def test_sizes_of_images_are_bounded() -> None:
    assert is_image_size(1, MAX_SIDE_PX) and not is_image_size(0, 10)
    assert not is_image_size(1, MAX_SIDE_PX + 1) and not is_image_size(9000, 9000)


def test_files_are_bounded_and_their_text_is_toml_of_a_known_schema(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", 5) == b"12345"
    with pytest.raises(CalibError, match="more than 4 bytes"):
        read_bytes(tmp_path / "a", 4)
    with pytest.raises(CalibError, match="cannot be read: No such file"):
        read_bytes(tmp_path / "b")
    with pytest.raises(CalibError, match="not a TOML file"):
        toml_table("a =", "f")
    with pytest.raises(CalibError, match="expected UTF-8 text, found byte 255 at 0"):
        toml_table(b"\xff", "f")
    require_schema(toml_table("schema = 2", "f"), 2)
    with pytest.raises(CalibError, match="schema: expected version 2, found True"):
        require_schema(toml_table("schema = true", "f"), 2)
