"""Extension of mkdocstrings: the comment of a dataclass's field (shape, unit) is shown as its description."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Takes the comment at the end of a field's line, or the lines of comment above it."""

    def on_attribute_instance(self, *, node: ast.AST | griffe.ObjectNode, attr: griffe.Attribute, **_: Any) -> None:
        """Describe a field that has no docstring by its comment."""
        is_field = isinstance(node, ast.AnnAssign) and attr.parent is not None and attr.parent.is_class
        if is_field and attr.docstring is None and isinstance(attr.filepath, Path) and attr.lineno:
            comment = comment_of(attr.filepath.read_text("utf-8").splitlines(), attr.lineno)
            if comment:
                attr.docstring = griffe.Docstring(comment, parent=attr)


def comment_of(lines: list[str], number: int) -> str:
    """Return the comment of the field in a line, counted from 1; empty where it has none."""
    after = re.search(r"\s{2}# (.*)$", lines[number - 1])
    if after:
        return after[1]
    above: list[str] = []
    for line in reversed(lines[: number - 1]):
        if not line.lstrip().startswith("# "):
            break
        above.insert(0, line.lstrip("# "))
    return " ".join(above)
