"""TOML of bounded size and depth: the text is scanned before tomllib, whose memory grows with the square of the depth.

A rig or a configuration may come from a log of unknown origin. Strings, which contain masks, do not count.
"""

from __future__ import annotations

import re
import tomllib
from typing import Any, Final

# More than any rig needs: the largest covariance has 12,720 correlations of 17 characters, 216 kB, on 160 lines.
MAX_BYTES: Final = 1 << 19
MAX_LINES: Final = 10_000
# Characters of a bare key or a number, more than any needs: the largest double written out has 309 digits.
MAX_WORD: Final = 400
# Dots of a key, because the deepest key of a rig or a configuration has 2.
MAX_DOTS: Final = 8

# Strings and comments (TOML 1.0); possessive, so that the time is linear. A quotation mark alone opens no string.
_STRINGS: Final = re.compile(
    r'"""[^"\\]*+(?:(?:\\[\s\S]|"(?!""))[^"\\]*+)*+""""{0,2}'
    r"|'''[^']*+(?:'(?!'')[^']*+)*+''''{0,2}"
    r'|"(?!"")[^"\\\n]*+(?:\\.[^"\\\n]*+)*+"'
    r"|'(?!'')[^'\n]*+'"
    r"""|(?P<open>["'])"""
    r"|#[^\n]*+"
)
_SEPARATORS: Final = re.compile(r"[^\w.\"+-]+")
_BLANKS: Final = str.maketrans("", "", " \t")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML text; raise ValueError for a malformed one, and for one beyond the limits of this module."""
    _check(_STRINGS.sub(_without_content, text))
    return tomllib.loads(text)


def _without_content(found: re.Match[str]) -> str:
    """Return an empty string for a string, nothing for a comment."""
    if found["open"]:
        raise ValueError("a string has no end")
    return "" if found[0].startswith("#") else '""'


def _check(bare: str) -> None:
    """Raise ValueError if a text without its strings and comments exceeds a limit."""
    if len(bare) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} characters beside strings, found {len(bare)}")
    if (lines := bare.count("\n")) > MAX_LINES:
        raise ValueError(f"expected at most {MAX_LINES} lines, found {lines}")
    for word in _SEPARATORS.split(bare.translate(_BLANKS)):
        if word.count(".") > MAX_DOTS:
            raise ValueError(f"expected a key of at most {MAX_DOTS + 1} parts, found {word.count('.') + 1}")
        if max(map(len, word.split("."))) > MAX_WORD:
            raise ValueError(f"expected keys and numbers of at most {MAX_WORD} characters, found {len(word)}")
