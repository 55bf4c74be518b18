"""Keys of the settings: the existing ones, the renamed ones of earlier versions, suggestions for a misspelt one."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from omnid.errors import OmnidError

Path: TypeAlias = tuple[str, ...]
MAX_UNIT_LETTERS: Final = 3  # Length of a unit at the end of a key, such as mps: it does not show which key is meant.
# Names of other programs (diff_drive_controller of ROS: wheel_separation) that are spelled like other keys.
ELSEWHERE: Final = {"wheel_base": "track_m", "wheelbase": "track_m", "wheel_separation": "track_m"}
_SHOWN: Final = 60  # characters of a value in a message


def shown(value: object) -> str:
    """Return a value from a file on one short line."""
    if isinstance(value, dict):
        return "a section"
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists of lists of lists
        return f"a huge {type(value).__name__}"
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def dotted(path: Sequence[str]) -> str:
    return ".".join(part if re.fullmatch(r"[\w-]{1,80}", part) else shown(part) for part in path)


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys that exist and those of earlier versions: makes the errors for all others."""

    known: tuple[Path, ...]
    renamed: Mapping[str, str]

    def moved(self, path: Path) -> OmnidError | None:
        """Return the error for a key that was renamed or removed, itself or with a section that it was in."""
        for depth in range(len(path), 0, -1):
            new = self.renamed.get(".".join(path[:depth]))
            if new is None:
                continue
            if " " in new:
                return OmnidError(f"{dotted(path)} was removed: {new}")
            moved = (*new.split("."), *path[depth:])
            if not any(known[: len(moved)] == moved for known in self.known):
                return OmnidError(f"{dotted(path[:depth])} is now called {new}, which has no {dotted(path[depth:])}")
            return OmnidError(f"{dotted(path)} is now called {dotted(moved)}")
        return None

    def unknown(self, path: Path) -> OmnidError:
        """Return the error for a key that never existed; it proposes similar ones of the section, else of the file."""
        neighbours = [other[: len(path)] for other in self.known if other[: len(path) - 1] == path[:-1]]
        family = [other for other in self.known if other[0] == path[0]]
        meant = (*path[:-1], _own_name(path[-1]))
        near = (
            _alike(meant, neighbours)
            or _alike(meant, family)
            or _sharing_a_word(meant, family)
            or _alike(meant, self.known)
        )
        if near:
            return OmnidError(
                f"unknown key {dotted(path)}: did you mean {' or '.join(map(dotted, near))}? "
                "`omnid config` explains each key"
            )
        names = ", ".join(map(dotted, dict.fromkeys(neighbours)))
        return OmnidError(f"unknown key {dotted(path)}: known are {names}")


def _own_name(name: str) -> str:
    """Return a name with the words of other programs replaced by those of omnid."""
    for other, own in ELSEWHERE.items():
        name = name.replace(other, own)
    return name


def _alike(path: Path, candidates: Sequence[Path]) -> list[Path]:
    """Return the key whose last word is most similar to the last word of a path, as a list of one key or none."""
    last = {other[-1]: other for other in candidates}
    return [last[name] for name in difflib.get_close_matches(path[-1][:80], last, n=1, cutoff=0.7)]


def _sharing_a_word(path: Path, candidates: Sequence[Path]) -> list[Path]:
    """Return at most three keys whose last part has a word of the path's last part, such as `velocity`."""
    words = {word for word in path[-1][:80].split("_") if len(word) > MAX_UNIT_LETTERS}
    return [other for other in candidates if words & set(other[-1].split("_"))][:3]
