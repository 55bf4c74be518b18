"""TOML of bounded size and depth."""

from __future__ import annotations

import tomllib

import pytest

from calib.bounded_toml import MAX_BYTES, MAX_DOTS, parse_toml


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a.b.c = 1.5e-3\n",
        "[a.b]\r\nc = '...........'\r\n",
        '"a.b.c.d.e.f.g.h.i.j.k" = 1',
        "a = 1 # ..........",
        'a = """\n"quoted" ""two\\""" .........."""',
        "a = '''...'....''...........'''",
        "a = '''x'''''",
        'a = """x"""""',
        "a = ''\nb = \"\"",
        'a = "\\"#.........."',
        "a = 'it is \"'\nb = '\\'",
        "a = 2001-01-01T00:00:00.5Z",
        "a = [" + "1.5, " * 5000 + "]",
        f"a = '{'0' * 10000}'",
        "# it's\na = 1",
        "a . b = { c = [ 0.1 , 0.2 ] }",
    ],
)
def test_parses_the_same_as_tomllib(text: str) -> None:
    assert parse_toml(text) == tomllib.loads(text)


@pytest.mark.parametrize("text", ["a = '", 'a = "x\ny"', 'a = """x', "a = '''x''", 'a = """"', "a = ''''"])
def test_refuses_a_string_without_an_end(text: str) -> None:
    with pytest.raises(ValueError, match="a string has no end"):
        parse_toml(text)


def test_limits_of_toml() -> None:
    parse_toml(".".join("a" * (MAX_DOTS + 1)) + " = 1")
    with pytest.raises(ValueError, match="found 10"):
        parse_toml(".".join("a" * (MAX_DOTS + 2)) + " = 1")
    parse_toml("a = '" + "x" * MAX_BYTES + "'")
