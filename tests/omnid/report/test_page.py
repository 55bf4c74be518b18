"""The page may load nothing, and runs its own script only."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path

from tests.omnid.report.pages import Page, html_of
from tests.omnid.report.recorded_logs import (
    run,
    save,
)


def test_the_page_may_load_nothing_and_run_its_own_script_only(tmp_path: Path) -> None:
    page = html_of(save(tmp_path / "run.mcap", run()))
    head = page[: page.index("<title>")]
    (script,) = Page(page).scripts
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-{digest}'"
    assert f"http-equiv='Content-Security-Policy' content=\"{policy}\"" in head
