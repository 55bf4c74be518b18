"""The charts in a real browser: values at the pointer, zoom, and no other script (`python -m pytest -m browser`)."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from omnid.report.report import report_html
from omnid.report.report_data import collect_report_data
from tests.omnid.report.recorded_logs import drive, odom, run, save

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [pytest.mark.browser, pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")]
SPEED = "svg[aria-label='Forward speed']"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of 10 s, with a speed that rises by 0.01 m/s each pose, and with a topic that is a script."""
    folder = tmp_path_factory.mktemp("report")
    entries = [odom(k, speed_mps=0.01 * k) for k in range(100)] + [drive(k, 0.4) for k in range(0, 100, 5)]
    entries += [odom(3, topic="/<script>document.title='run'</script>/odom")]
    log = save(folder / "run.mcap", [*entries, *(entry for entry in run(100) if entry[1] == "/omnid/status")])
    path = folder / "run.html"
    path.write_text(report_html(log, collect_report_data(log, "/omnid/odom")), "utf-8")
    return path


@pytest.fixture(params=[(390, 844), (1440, 900)], ids=["phone", "desk"])
def page(request: pytest.FixtureRequest, report: Path) -> Iterator[Any]:
    """The report as a file, without an error in the browser."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        found = browser.new_page(viewport=dict(zip(("width", "height"), request.param, strict=True)))
        errors: list[str] = []
        found.on("pageerror", lambda error: errors.append(str(error)))
        found.on("console", lambda message: errors.append(message.text))
        found.goto(report.as_uri())
        yield found
        browser.close()
    assert errors == []


def across(page: Any, share: float, selector: str = SPEED) -> tuple[float, float]:
    """Return a point of a figure in the window: at a share of its width, in the middle of its height."""
    figure = page.locator(selector)
    figure.scroll_into_view_if_needed()
    box = figure.bounding_box()
    return box["x"] + share * box["width"], box["y"] + 0.4 * box["height"]


def shown(page: Any, figure: str = "figure.chart") -> str:
    return str(
        page.locator(figure, has=page.locator(SPEED) if figure == "figure.chart" else None)
        .locator("output")
        .text_content()
    )


def test_the_pointer_shows_time_and_values_and_the_place_on_the_plan(page: Any) -> None:
    page.mouse.move(*across(page, 0.5))
    found = re.fullmatch(r"([\d.]+) s · measured ([\d.]+) · sent to the wheels ([\d.]+)", shown(page))
    assert found is not None
    time_s, measured, sent = map(float, found.groups())
    assert 4 < time_s < 6 and measured == pytest.approx(0.1 * time_s, abs=0.006)
    assert sent == pytest.approx(0.4, abs=0.01)
    assert page.locator("circle.robot").get_attribute("visibility") == "visible"
    page.mouse.move(*across(page, 0.4, "figure.plan > svg"))
    assert re.match(r"x -?[\d.]+ m, y -?[\d.]+ m · [\d.]+ s", shown(page, "figure.plan"))
    assert page.title() == "omnid: run.mcap", "the topic of the log is not run"
    assert page.evaluate("document.documentElement.scrollWidth") <= page.viewport_size["width"]


def test_a_drag_zooms_all_charts_and_the_button_shows_all_again(page: Any) -> None:
    before = [chart.text_content() for chart in page.locator("g.time").all()]
    page.mouse.move(*across(page, 0.3))
    page.mouse.down()
    page.mouse.move(*across(page, 0.4), steps=3)
    page.mouse.up()
    zoomed = [chart.text_content() for chart in page.locator("g.time").all()]
    assert len(before) > 3 and len(set(before)) == len(set(zoomed)) == 1 and zoomed != before
    page.mouse.move(*across(page, 0.5))
    time_s, measured = map(float, re.findall(r"[\d.]+", shown(page))[:2])
    assert 2 < time_s < 4 and measured == pytest.approx(0.1 * time_s, abs=0.006)
    page.locator("button", has_text="show all").click()
    assert [chart.text_content() for chart in page.locator("g.time").all()] == before
    assert page.locator("button.all").is_hidden()
