"""Figures of the modules: `python -m tests.documents.modules [--untested] [--draw SEED]`.

It prints how many modules and lines `calib`, `drivers` and `omnid` have, and how many modules have no test file of
their name: a test of omnid/x/y.py is tests/omnid/x/test_y.py. `--untested` lists those. `--draw` lists modules that a
seed draws, to be read aloud: does a reader who opens one for the first time understand it?
"""

from __future__ import annotations

import argparse
import random
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
LAYERS: Final = ("calib", "drivers", "omnid")
DRAWN: Final = 25


def modules(root: Path = ROOT) -> list[Path]:
    """Return the modules relative to root, sorted; files that make a folder a package are not counted."""
    found = (path.relative_to(root) for layer in LAYERS for path in (root / layer).rglob("*.py"))
    return sorted((path for path in found if path.name != "__init__.py"), key=Path.as_posix)


def untested(root: Path = ROOT) -> list[Path]:
    """Return the modules that have no test file of their name."""
    return [path for path in modules(root) if not (root / "tests" / path.parent / f"test_{path.name}").exists()]


def drawn(found: list[Path], seed: int) -> list[Path]:
    """Return the modules that a seed draws."""
    return random.Random(seed).sample(found, min(DRAWN, len(found)))


def main() -> None:
    """Print the figures, and the lists that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--untested", action="store_true", help="list the modules without a test file of their name")
    parser.add_argument("--draw", type=int, metavar="SEED", help="list the modules that a seed draws")
    args = parser.parse_args()
    found, lacking = modules(), untested()
    lines = sum(len(path.read_text("utf-8").splitlines()) for layer in LAYERS for path in (ROOT / layer).rglob("*.py"))
    print(f"{len(found)} modules, {lines} lines; {len(lacking)} modules without a test file of their name")
    shown = (lacking if args.untested else []) + ([] if args.draw is None else drawn(found, args.draw))
    print(*shown, sep="\n")


if __name__ == "__main__":
    main()
