"""The list of recordings and their reports, over the server."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.logs.file_lock import lock
from omnid.errors import OmnidError
from omnid.web.recordings import Recordings
from tests.omnid.web.servers import WebServer


def listed(server: WebServer) -> dict[str, dict[str, object]]:
    found = json.loads(server.request("/recordings", headers=server.bearer).text)["recordings"]
    return {entry["name"]: entry for entry in found}


def test_recordings_are_listed_and_reported(server: WebServer, recordings: Path, tmp_path: Path) -> None:
    assert listed(server) == {}
    sample = Path(str(files("omnid.sample") / "log.mcap"))
    shutil.copy(sample, recordings / "images_20261122T050000Z_001.mcap")
    (recordings / "cut.mcap.part").write_bytes(b"\x89MCAP0\r\n")
    (recordings / "notes.txt").write_text("no recording")
    (recordings / "elsewhere.mcap").symlink_to("/etc/passwd")
    (recordings / "folder.mcap").mkdir()
    odd = os.fsencode(recordings) + b"/<b>\xff\n.mcap"
    Path(os.fsdecode(odd)).write_bytes(b"nothing")
    (recordings / "cut.mcap").write_bytes(sample.read_bytes()[:-1])
    (recordings / "empty.mcap").touch()
    with (recordings / "now.mcap.part").open("wb") as written:
        lock(written)
        found = listed(server)
    assert {name: entry["state"] for name, entry in found.items()} == {
        "images_20261122T050000Z_001.mcap": "whole",
        "cut.mcap.part": "cut",
        "cut.mcap": "cut",
        "empty.mcap": "no log",
        r"<b>\xff\n.mcap": "no log",
        "now.mcap.part": "being written",
    }
    assert found["images_20261122T050000Z_001.mcap"]["size_bytes"] == sample.stat().st_size
    odd_key = found[r"<b>\xff\n.mcap"]["key"]
    answer = server.request(f"/recordings/{odd_key}/report", "POST", server.bearer)
    text = json.loads(answer.text)["text"]
    assert answer.status == 409 and text.startswith("omnid: ") and "Traceback" not in text
    with ThreadPoolExecutor(2) as threads:
        path = f"/recordings/{found['images_20261122T050000Z_001.mcap']['key']}/report"
        answers = list(threads.map(lambda _: server.request(path, "POST", server.bearer).text, range(2)))
    assert sum("another report is being made" in answer for answer in answers) == 1, answers
    assert sum('"text":"omnid: ' in answer for answer in answers) == 1, "it has no poses"
    missing = server.request("/recordings/0123/report", "POST", server.bearer)
    assert missing.status == 409 and "not there" in missing.text


def test_a_program_that_fails_otherwise_is_one_line_without_its_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program finds the modules of this one: here one that raises."""
    (tmp_path / "modules" / "rosbags").mkdir(parents=True)
    (tmp_path / "modules" / "rosbags" / "__init__.py").write_text("raise RuntimeError('/a/path')")
    monkeypatch.syspath_prepend(tmp_path / "modules")
    (tmp_path / "one\x1b.mcap").write_bytes(b"nothing")
    recordings = Recordings(tmp_path, tmp_path)
    with pytest.raises(OmnidError) as refused:
        asyncio.run(recordings.report(recordings.list()[0].key))
    assert str(refused.value) == (
        r"omnid: the report about one\x1b.mcap failed (exit code 1): run `omnid report` "
        "on it to see why"
    )
