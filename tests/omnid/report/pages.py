"""Pages of reports: their tags, and what in them could do harm."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

from calib.rig import Rig
from drivers.logs.log_reader import LogReader
from omnid.formats.tum import Trajectory
from omnid.report.charts import style_and_script
from omnid.report.recorded_run import RecordedRun
from omnid.report.report import report_html
from omnid.runs.session import attached_rig

SAMPLE = Path(__file__).parents[3] / "omnid" / "sample"


class Page(HTMLParser):
    """Tags with their attributes and text of a page; asserts that the tags match."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.scripts: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            self.scripts.append(data)
        else:
            self.text += data


def html_of(path: Path, truth: Trajectory | None = None) -> str:
    return report_html(RecordedRun(path), truth)


def assert_harmless(page: Page) -> None:
    """Assert that nothing in the page is executed or fetched."""
    names = {tag for tag, _ in page.tags}
    assert len(page.scripts) == 1 and page.scripts[0] == style_and_script()[1], "omnid's own, which the policy allows"
    assert not names & {"iframe", "object", "embed", "link", "base", "form", "foreignobject"}
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/png;base64,", "data:image/jpeg;base64,"))


def attached_rig_of_sample() -> Rig:
    reader = LogReader(SAMPLE / "log.mcap")
    rig = attached_rig(reader, SAMPLE / "log.mcap")
    reader.close()
    return rig
