"""A panorama of a log with images."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader

from calib.rig_file import rig_toml
from tests.omnid.report.pages import SAMPLE, Page, attached_rig_of_sample, html_of
from tests.omnid.report.recorded_logs import (
    at,
    run,
    save,
)


def test_shows_a_panorama_of_a_log_with_images(tmp_path: Path) -> None:
    """The log holds the sample's first images, and poses."""
    entries = run(20)
    with (SAMPLE / "log.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if message.log_time > at(19):
                break
            entries.append((message.log_time, channel.topic, schema.name, message.data))
    log = save(tmp_path / "log.mcap", entries, {"rig.toml": rig_toml(attached_rig_of_sample()).encode()})
    page = Page(html_of(log))
    assert [tag for tag, _ in page.tags].count("img") == 1 and "panorama at the first pose" in page.text
