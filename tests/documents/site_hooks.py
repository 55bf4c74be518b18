"""Hooks of mkdocs: documents that stand beside the code become parts of pages, and paths become links.

A line `[included: omnid/core/README.md](../omnid/core/README.md)` of a page in docs/ is a link where the repository is
read, and is replaced by that file on the site; `[code: PATH](LINK)` by the file as a block of code. Headings of a file
move one level down below the page's own heading. Links and code such as `omnid/core/README.md` that name a file of
the site become links to its page; links to other files of the repository become plain text. GitHub's Markdown is
adapted to Python-Markdown: blank lines before lists and tables.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:  # the tests of this module need no mkdocs
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = ROOT / "docs"
INCLUDE: Final = re.compile(r"^\[included: ([\w./-]+)\]\([^)]+\)$", re.MULTILINE)
CODE: Final = re.compile(r"^\[code: ([\w./-]+)\]\([^)]+\)$", re.MULTILINE)
LANGUAGES: Final = {".py": "python", ".yaml": "yaml"}
IMAGES: Final = (".png", ".jpg", ".gif", ".svg")
IMAGE_FOLDER: Final = "included"  # of the site, for images outside docs/
_LINK: Final = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
_CODE: Final = re.compile(r"(?<![\[`])`([\w./-]+)`(?!`)")
_ITEM: Final = re.compile(r"^ {0,3}(?:[-*]|\d+\.) ")


@cache
def pages() -> dict[str, str]:
    """Return the page, relative to docs/, of each file of the repository that is on the site."""
    found = {}
    for path in sorted(DOCS.rglob("*.md")):
        name = path.relative_to(DOCS).as_posix()
        found[f"docs/{name}"] = name
        found |= {source: name for source in INCLUDE.findall(path.read_text("utf-8"))}
    folders = {
        PurePosixPath(source).parent.as_posix(): page
        for source, page in found.items()
        if source.startswith("docs/") and source.endswith("/README.md")
    }
    return found | folders


def included(page: str, text: str) -> str:
    """Return the text of a page with the files that it includes."""

    def replaced(match: re.Match[str]) -> str:
        source = match.group(1)
        return linked((ROOT / source).read_text("utf-8"), source, page, deeper="\n# " in f"\n{text}")

    return CODE.sub(_listing, INCLUDE.sub(replaced, linked(text, f"docs/{page}", page)))


def _listing(match: re.Match[str]) -> str:
    path = ROOT / match.group(1)
    return f"`{path.name}`:\n\n```{LANGUAGES[path.suffix]}\n{path.read_text('utf-8')}```"


def linked(text: str, source: str, page: str, *, deeper: bool = False) -> str:
    """Return the text of a file of the repository with links as on that page; deeper: headings one level down."""
    lines: list[str] = []
    for line, is_code in prose_and_code(text):
        if not (is_code or INCLUDE.match(line) or CODE.match(line)):
            line = _prose(line, source, page, deeper)
            if _needs_blank(line, lines):
                lines.append("")
        lines.append(line)
    return "\n".join(lines)


def prose_and_code(text: str) -> Iterator[tuple[str, bool]]:
    """Yield each line, and True where it belongs to a block of code."""
    fenced = False
    for line in text.splitlines():
        is_fence = line.lstrip().startswith("```")
        yield line, fenced or is_fence or line.startswith("    ")
        fenced ^= is_fence


def _needs_blank(line: str, before: list[str]) -> bool:
    """True if Python-Markdown would take the beginning of a list or a table for a part of the paragraph before."""
    last = before[-1] if before else ""
    if not last or last.startswith((" ", "#")):
        return False
    starts_item = bool(_ITEM.match(line)) and not _ITEM.match(last)
    return starts_item or (line.startswith("|") and not last.startswith("|"))


def _prose(line: str, source: str, page: str, deeper: bool) -> str:
    if deeper and re.match(r"#+ ", line):
        line = f"#{line}"
    line = re.sub(r"^ {2,3}(?=[-*] )", "    ", line)  # Python-Markdown nests lists by four blanks
    line = _LINK.sub(lambda match: _link(match, source, page), line)
    return _CODE.sub(lambda match: _code(match, source, page), line)


def _link(match: re.Match[str], source: str, page: str) -> str:
    mark, words, target = match.groups()
    is_quoted = match.string[: match.start()].count("`") % 2 == 1
    if is_quoted or re.match(r"\w+:|#", target):
        return match.group()
    path, _, anchor = target.partition("#")
    address = _address(_resolved(path, source), page)
    if address is None:
        return str(words)
    return f"{mark}[{words}]({address}{'#' if anchor else ''}{anchor})"


def _code(match: re.Match[str], source: str, page: str) -> str:
    """Return code that names a file of another page as a link to it."""
    name = match.group(1).rstrip("/")
    for path in (name, _resolved(name, source)):
        if pages().get(path, page) != page:
            return f"[`{match.group(1)}`]({_address(path, page)})"
    return match.group()


def _resolved(path: str, source: str) -> str:
    """Return a path relative to a file as one relative to the root of the repository."""
    return os.path.normpath(PurePosixPath(source).parent / path)


def _address(path: str, page: str) -> str | None:
    """Return the address of a file of the repository, relative to a page; None where the site does not have it."""
    if path in pages():
        name = pages()[path]
    elif path.endswith(IMAGES):
        name = path.removeprefix("docs/") if path.startswith("docs/") else f"{IMAGE_FOLDER}/{path}"
    elif path.startswith("docs/") and (ROOT / path).is_file():
        name = path.removeprefix("docs/")
    else:
        return None
    return os.path.relpath(name, PurePosixPath(page).parent)


def included_images() -> set[str]:
    """Return the images outside docs/, relative to the root, that included files show."""
    found = set()
    for source in pages():
        if source.endswith(".md") and not source.startswith("docs/"):
            text = (ROOT / source).read_text("utf-8")
            shown = [target for mark, _, target in _LINK.findall(text) if mark and ":" not in target]
            found |= {_resolved(target, source) for target in shown}
    return {path for path in found if not path.startswith("docs/")}


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the images of included files to the site."""
    from mkdocs.structure.files import File

    for path in sorted(included_images()):
        files.append(File.generated(config, f"{IMAGE_FOLDER}/{path}", abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the text of a page as the site shows it."""
    return included(page.file.src_uri, markdown)
