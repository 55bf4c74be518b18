"""Table of the numeric constants of omnid/core and calib: `python -m tests.benchmark.constants [--write] [--missing]`.

A constant is a module-level name in capitals whose value contains a number, or a knob of a settings class. Its comment
is behind it, or above it, where it holds up to the next comment or empty line: for lines without a comment behind them,
and for the others if it says so ("where a line gives no other reason"). A comment that only says what the constant is
describes it; one that says why it has this value (a cause, a source, a measurement, a trial) gives its reason. Words
decide that: a person judges whether the reason is a good one. One that says "by judgement" gives none and says so: it
is counted apart. `--write` makes docs/constants.md, `--missing` lists what says neither.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = ("omnid/core", "calib")
PAGE: Final = ROOT / "docs" / "constants.md"
UNITS: Final = {
    "PX": "px",
    "M": "m",
    "MM": "mm",
    "S": "s",
    "MS": "ms",
    "US": "us",
    "NS": "ns",
    "RAD": "rad",
    "DEG": "deg",
    "MPS": "m/s",
    "RADPS": "rad/s",
    "HZ": "Hz",
    "BYTES": "bytes",
    "MB": "MB",
    "KB": "kB",
    "GREY": "grey levels",
    "RATIO": "share",
    "SHARE": "share",
    "PART": "share",
    "SIGMA": "sigma",
    "SIGMAS": "sigma",
    "SQUARED": "squared",
}
# Words by which a comment says why. A colon, or "must", is none: what follows it may only describe.
CAUSES: Final = (
    r"because|since|so that|so (?:many|much|small|large|wide|few) that|(?<=, )so(?! many| much)|therefore|otherwise",
    r"never|cannot|hardly|enough|needs|needed|would|may not|covers|guards? against|for few|stays? below|exact",
    r"too (?:many|few|small|large|long|short|near|far)|no (?:more|less|longer)|more than (?:the|any)|larger than any",
    r"are not resolved|(?:say|tell)s? (?:nothing|the same)|misread|to the last digit|rounding|of a normal distribution",
)
MEASUREMENTS: Final = (r"(?<!is )(?<!are )(?<!not )measured|by trial|fitted on|set (?:by|on|with|to)",)
SOURCES: Final = (
    r"sources?:|\(source|section [IVX\d]|eq\.|et al|the paper|the standard(?! deviation)|IEEE|ISO|RFC|REP \d",
    r"OpenCV's|by OpenCV|as in|as for|by default|'s default|the limit of",
)
REASON: Final = re.compile(
    rf"(?:(?<!\w)(?:{'|'.join((*CAUSES, *MEASUREMENTS, *SOURCES))}))(?!\w)|\([^()]* (?:19|20)\d\d\)", re.IGNORECASE
)
# What says plainly that there is no reason but somebody's judgement, whatever else the comment says.
JUDGEMENT: Final = re.compile(r"\bby judgement\b", re.IGNORECASE)
# A comment above lines that gives the reason of those whose own comment gives none.
GROUP: Final = re.compile(r"\bwhere a line gives no other reason\b")
SOURCE: Final = re.compile(
    r"\([A-Z][\w .&-]* (?:et al\.,? )?(?:19|20)\d\d[^)]*\)|Dang et al[^:;]*|(?:section|eq\.) [IVX()\d.A-Z]+"
    r"|Keys(?: 1981)?|OpenCV's? \w+|the paper's? [\w ]+|REP \d+|Source: [^.;]+"
)
SEEDS: Final = re.compile(r"[Ss]et (?:by|on|with)[^.;]*|(?:[Bb]y trial on )?(?:development )?seeds(?: [\d ,to]+)?")


@dataclass(frozen=True, slots=True)
class Constant:
    """A numeric constant or the default of a knob."""

    path: str  # relative to the repository
    line: int
    name: str
    value: str
    comment: str
    is_knob: bool = False

    @property
    def unit(self) -> str:
        """Unit by the ending of the name, empty for a count or a share."""
        return UNITS.get(self.name.upper().rpartition("_")[2], "")

    @property
    def has_reason(self) -> bool:
        """True if the comment says why the value is this one."""
        return REASON.search(self.comment) is not None and not self.is_by_judgement

    @property
    def is_by_judgement(self) -> bool:
        """True if the comment says that the value was judged and not measured."""
        return JUDGEMENT.search(self.comment) is not None

    @property
    def source(self) -> str:
        """The publication or standard that the comment names."""
        found = SOURCE.search(self.comment)
        return found[0].strip("() ") if found else ""

    @property
    def seeds(self) -> str:
        """The seeds or logs that the comment names."""
        found = SEEDS.search(self.comment)
        return found[0].strip() if found else ""


def constants(root: Path = ROOT) -> list[Constant]:
    """Return all constants of the packages, in the order of files and lines."""
    paths = (path for package in PACKAGES for path in sorted((root / package).rglob("*.py")))
    return [one for path in paths for one in constants_of(path.read_text(), path.relative_to(root).as_posix())]


def constants_of(text: str, path: str) -> list[Constant]:
    """Return the constants of one file."""
    comments, tree = Comments(text), ast.parse(text)
    found = [constant for node in tree.body for constant in _assigned(node, comments, path)]
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            found += [knob for part in node.body for knob in _knob(part, comments, path)]
    return sorted(found, key=lambda constant: constant.line)


class Comments:
    """The lines of a file, and its comments by line."""

    def __init__(self, text: str) -> None:
        self._text, self._lines = text, text.splitlines()

    @cached_property
    def _of(self) -> dict[int, str]:
        """The comments; only files with constants are tokenized for them."""
        tokens = tokenize.generate_tokens(io.StringIO(self._text).readline)
        return {token.start[0]: token.string.lstrip("# ").strip() for token in tokens if token.type == tokenize.COMMENT}

    def source_of(self, part: ast.expr) -> str:
        """Return the source of an expression in one line; ast.get_source_segment would split the whole file again."""
        rows = [line.encode() for line in self._lines[part.lineno - 1 : part.end_lineno]]
        rows[-1] = rows[-1][: part.end_col_offset]
        rows[0] = rows[0][part.col_offset :]
        return " ".join(b" ".join(rows).decode().split())

    def at(self, first: int, last: int) -> str:
        """Return the comments of an assignment: that behind it, else that above it, or both.

        A comment above holds up to the next one, or to the next empty line, for the lines without one behind them; for
        the others where it says so (GROUP), unless theirs gives a reason or says that there is none.
        """
        behind = self._joined(line for line in range(first, last + 1) if line in self._of)
        above = self._above(first)
        if behind and (REASON.search(behind) or JUDGEMENT.search(behind) or not GROUP.search(above)):
            return behind
        return f"{above} {behind}".strip()

    def _above(self, line: int) -> str:
        """Return the comment above a line that holds for it, empty where there is none."""
        while line > 1 and self._lines[line - 2].strip() and not self._is_comment(line - 1):
            line -= 1
        first = line
        while first > 1 and self._is_comment(first - 1):
            first -= 1
        return self._joined(range(first, line))

    def _is_comment(self, line: int) -> bool:
        """True if a line holds nothing but a comment."""
        return self._lines[line - 1].lstrip().startswith("#")

    def _joined(self, lines: Iterable[int]) -> str:
        return " ".join(self._of[line] for line in lines)


def _is_neutral(value: ast.expr) -> bool:
    """True if a value is built of zeros and ones, as Pose2(0.0, 0.0, 0.0) and np.eye(3): what changes nothing."""
    if not isinstance(value, ast.Call):
        return False
    numbers = [
        part.value for part in ast.walk(value) if isinstance(part, ast.Constant) and type(part.value) in (int, float)
    ]
    return ast.unparse(value.func) in ("np.eye", "np.zeros") or (len(numbers) > 0 and {*numbers} <= {0, 1})


def _assigned(node: ast.stmt, comments: Comments, path: str) -> Iterator[Constant]:
    """Yield the constants of a module-level assignment; a tuple of names has one value each."""
    if isinstance(node, ast.Assign) and len(node.targets) == 1:
        target, value = node.targets[0], node.value
    elif isinstance(node, ast.AnnAssign) and node.value is not None:
        target, value = node.target, node.value
    else:
        return
    names = target.elts if isinstance(target, ast.Tuple) else [target]
    parts = value.elts if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) else [value] * len(names)
    if is_structure(names, parts):
        return
    for name, part in zip(names, parts, strict=True):
        if isinstance(name, ast.Name) and name.id.strip("_").isupper() and has_number(part):
            shown = comments.source_of(part)
            yield Constant(path, node.lineno, name.id, shown, comments.at(node.lineno, node.end_lineno or node.lineno))


def has_number(value: ast.expr) -> bool:
    """True if a number, which is no index and no part of a text, occurs in an expression."""
    if isinstance(value, ast.Subscript):
        return has_number(value.value)
    if isinstance(value, ast.Constant):
        return type(value.value) in (int, float)
    return any(isinstance(part, ast.expr) and has_number(part) for part in ast.iter_child_nodes(value))


def is_structure(names: Sequence[ast.expr], parts: Sequence[ast.expr]) -> bool:
    """True if the names count positions, as FIRST, SECOND = 0, 1, or spell the number, as ONE = np.float32(1.0).

    Such names have no value that could be another one, nor have neutral elements.
    """
    numbers = [part.value for part in parts if isinstance(part, ast.Constant)]
    counts = len(names) > 1 and numbers == list(range(len(names)))
    spelled = {"NOTHING": 0.0, "ZERO": 0.0, "HALF": 0.5, "ONE": 1.0, "FIRST": 1, "SECOND": 2, "THIRD": 3}
    if counts or all(map(_is_neutral, parts)):
        return True
    return all(
        isinstance(name, ast.Name)
        and name.id in spelled
        and isinstance(part, ast.Call)
        and [arg.value for arg in part.args if isinstance(arg, ast.Constant)] == [spelled[name.id]]
        for name, part in zip(names, parts, strict=True)
    )


def _knob(node: ast.stmt, comments: Comments, path: str) -> Iterator[Constant]:
    """Yield the numeric default of a knob; its description is its comment."""
    if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and isinstance(node.value, ast.Call)):
        return
    call = node.value
    if isinstance(call.func, ast.Name) and call.func.id == "knob" and len(call.args) > 1 and has_number(call.args[0]):
        text = str(call.args[1].value) if isinstance(call.args[1], ast.Constant) else ""
        behind = comments.at(node.lineno, node.end_lineno or node.lineno)
        yield Constant(path, node.lineno, node.target.id, ast.unparse(call.args[0]), f"{text} {behind}".strip(), True)


def page(found: list[Constant]) -> str:
    """Return the document: a summary for each room, then a table for each file."""
    rooms = Counter(Path(one.path).parent.as_posix() for one in found)
    lacking = Counter(Path(one.path).parent.as_posix() for one in missing(found))
    judged = Counter(Path(one.path).parent.as_posix() for one in by_judgement(found))
    lines = [
        "# Constants of omnid/core and calib",
        "",
        "Made by `python -m tests.benchmark.constants --write`. A constant without a comment, or whose comment "
        "says what it is and not why it has this value, counts as one without a reason. One that was set by judgement, "
        "and neither derived nor measured, says so in its comment.",
        "",
        "| room | constants and settings | constants by judgement | constants without a reason |",
        "|---|---|---|---|",
        *(f"| `{room}` | {count} | {judged[room]} | {lacking[room]} |" for room, count in sorted(rooms.items())),
        f"| all | {len(found)} | {sum(judged.values())} | {sum(lacking.values())} |",
    ]
    for path in sorted({one.path for one in found}):
        lines += [
            "",
            f"## `{path}`",
            "",
            "| name | value | unit | reason | source | set on |",
            "|---|---|---|---|---|---|",
        ]
        lines += [
            f"| `{one.name}` | `{_cell(one.value)}` | {one.unit} | {_cell(one.comment)} | {_cell(one.source)} | "
            f"{_cell(one.seeds)} |"
            for one in found
            if one.path == path
        ]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def missing(found: list[Constant]) -> list[Constant]:
    """Return the constants without a reason that do not say so; settings have descriptions instead."""
    return [one for one in found if not one.is_knob and not one.has_reason and not one.is_by_judgement]


def by_judgement(found: list[Constant]) -> list[Constant]:
    """Return the constants whose comment says that they were judged and not measured."""
    return [one for one in found if not one.is_knob and one.is_by_judgement]


def main() -> None:
    """Print the counts; write the document or list what lacks a reason."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="make docs/constants.md")
    parser.add_argument("--missing", action="store_true", help="list the constants without a reason")
    args, found = parser.parse_args(), constants()
    if args.write:
        PAGE.parent.mkdir(exist_ok=True)
        PAGE.write_text(page(found))
    if args.missing:
        for one in missing(found):
            print(f"{one.path}:{one.line}: {one.name} = {one.value}  # {one.comment or 'no comment'}")
    undescribed, judged = sum(not one.comment for one in found), len(by_judgement(found))
    print(
        f"{len(found)} constants and settings, {sum(one.is_knob for one in found)} of them settings; "
        f"{undescribed} without a comment, {judged} by judgement, {len(missing(found))} without a reason"
    )


if __name__ == "__main__":
    main()
