"""Elements of a self-contained HTML page: head, tables, embedded images."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

# Control characters except tab and newline, which a terminal would obey where the page is printed.
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def page(title: str, parts: Sequence[str], style: str = "", script: str = "") -> str:
    """Return an HTML page of parts, which are HTML; style is appended to page.css. It may run the script, and no other.

    A page shows text from logs of unknown origin: it loads nothing, and runs only the script with this digest.
    """
    own_style = (files("omnid.report") / "page.css").read_text("utf-8")
    script = _CONTROL.sub("\N{REPLACEMENT CHARACTER}", script)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"; script-src 'sha256-{digest}'" if script else ""
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:{allowed}"
    text = (
        f"<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><meta http-equiv='Content-Security-Policy' "
        f"content=\"{policy}\"><meta name='viewport' content='width=device-width'>"
        f"<title>{escape(title)}</title><style>{own_style}{style}</style></head>"
        f"<body>{''.join(parts)}{f'<script>{script}</script>' if script else ''}</body></html>\n"
    )
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; cells are HTML, those that begin with <td as they are."""
    titles = "".join(f"<th>{title}</th>" for title in head)
    lines = ["".join(cell if cell.startswith("<td") else f"<td>{cell}</td>" for cell in row) for row in rows]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in (titles, *lines))}</table>"


def facts(rows: Sequence[Sequence[str]]) -> str:
    """Return a table of names and values; both are HTML."""
    return f"<div class='words facts'>{table(('', ''), rows)}</div>"


def note(text: str) -> str:
    """Return a paragraph with a remark."""
    return f"<p class='note'>{escape(text)}</p>"


def embedded(image: Image, kind: str = "jpeg") -> str:
    """Return the tag of an image; kind: jpeg, or png for drawings."""
    data = cv2.imencode(f".{kind}", image)[1]
    return f"<img src='data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}' alt=''>"


def figure(image: Image, caption: str) -> str:
    """Return an embedded image with a caption."""
    return f"<figure>{embedded(image)}<figcaption>{escape(caption)}</figcaption></figure>"
