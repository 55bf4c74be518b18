"""Attacks on omnid and their outcomes, by room: the records of attacks.toml."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

FILE: Final = Path(__file__).with_name("attacks.toml")
LIMITS: Final = "Known limits"


@dataclass(frozen=True, slots=True)
class Attack:
    """An attack on a room, its outcome, and the arguments of pytest for its tests (none: tried by hand)."""

    room: str
    tried: str
    outcome: str
    tests: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Room:
    """The attacks on a part of omnid, and the limits that are known and not mended."""

    title: str
    limits: tuple[str, ...]
    attacks: tuple[Attack, ...]


def rooms() -> list[Room]:
    """Return the rooms in the order of the file."""
    parts = tomllib.loads(FILE.read_text("utf-8"))
    return [
        Room(
            part["title"],
            tuple(part["limits"]),
            tuple(
                Attack(part["title"], record["tried"], record["outcome"], tuple(record["tests"]))
                for record in part["attacks"]
            ),
        )
        for part in parts.values()
    ]


def titles() -> list[str]:
    """Return the headings of the sections."""
    return [*(room.title for room in rooms()), LIMITS]


def sections() -> Iterator[str]:
    """Yield the sections of the page: a table for each room, then the limits by room."""
    for room in rooms():
        rows = (f"| {_cell(attack.tried)} | {_cell(attack.outcome)} | {_tests(attack)} |" for attack in room.attacks)
        yield f"## {room.title}"
        yield "\n".join(["| tried | outcome | `python -m pytest ...` |", "|---|---|---|", *rows])
    yield f"## {LIMITS}"
    yield "[SAFETY](../../omnid/controller/SAFETY.md) names those that are left to the integrator."
    for room in rooms():
        if room.limits:
            yield "\n".join([f"**{room.title}**\n", *(f"- {limit}" for limit in room.limits)])


def _tests(attack: Attack) -> str:
    return "<br>".join(f"`{command}`" for command in attack.tests) or "by hand"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
