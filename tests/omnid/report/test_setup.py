"""The configuration of a recording, bounded."""

from __future__ import annotations

from pathlib import Path

from tests.omnid.report.pages import html_of
from tests.omnid.report.recorded_logs import (
    run,
    save,
)


def test_settings_of_many_dotted_keys_are_not_parsed(tmp_path: Path) -> None:
    settings = ("a." * 20_000 + "a = 1").encode()
    log = save(tmp_path / "run.mcap", run(), {"omnid.toml": settings})
    assert "The attached settings cannot be read." in html_of(log)
