"""Page of all settings: `python -m tests.documents.configuration` writes docs/configuration.md from their knobs."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, Final

from omnid.config import Config
from omnid.config_use import USED_ONLY_BY
from omnid.settings import described, fields_of, knob_of

PAGE: Final = Path(__file__).parents[2] / "docs" / "configuration.md"
HEAD: Final = """# Configuration
Made by `python -m tests.documents.configuration` from the settings themselves.

The configuration is one TOML file; what it leaves out has the default. An unknown key is an error that names the
nearest known one.
```
omnid config --minimal > omnid.toml                      # a file to start from; without --minimal: all settings
omnid config check omnid.toml                            # is it right, and what differs from the defaults
omnid replay log.mcap --config omnid.toml --set stereo.min_range_m=0.5
```
"""


def page() -> str:
    """Return the text of the page."""
    return HEAD + "\n".join(_sections(Config(), ())) + "\n"


def _sections(settings: Any, path: tuple[str, ...]) -> Iterator[str]:
    rows = [
        _row(entry, kind, getattr(settings, entry.name), ".".join((*path, entry.name)))
        for entry, kind in fields_of(type(settings))
        if not is_dataclass(kind)
    ]
    if path:
        yield f"\n## {'.'.join(path)}"
        yield (inspect.getdoc(type(settings)) or "").splitlines()[0] + _only(".".join(path))
    if rows:
        yield "\n| key | default | range | meaning |\n|---|---|---|---|"
        yield from rows
    for entry, kind in fields_of(type(settings)):
        if is_dataclass(kind):
            yield from _sections(getattr(settings, entry.name), (*path, entry.name))


def _row(entry: Any, kind: Any, default: object, path: str) -> str:
    about = knob_of(entry)
    shown = json.dumps(default, ensure_ascii=False)
    meaning = f"{about.doc}{'.' if _only(path) else ''}{_only(path)}"
    cells = (f"`{entry.name}`", f"`{shown}`", described(kind, about), meaning)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _only(path: str) -> str:
    """Return a sentence where a single command uses a section or a key."""
    command = USED_ONLY_BY.get(path)
    return f" Used by `omnid {command}` only." if command else " Used by both commands." if command == "" else ""


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), "utf-8")
    print(f"{PAGE}: {PAGE.read_text('utf-8').count('## ')} sections")


if __name__ == "__main__":
    main()
