"""The list of recordings and their reports, over the server."""

from __future__ import annotations

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path

from drivers.logs.file_lock import lock
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
    with (recordings / "now.mcap.part").open("wb") as written:
        lock(written)
        found = listed(server)
    assert set(found) == {"images_20261122T050000Z_001.mcap", "cut.mcap.part", "<b>??.mcap", "now.mcap.part"}
    assert found["images_20261122T050000Z_001.mcap"]["size_bytes"] == sample.stat().st_size
    assert (found["now.mcap.part"]["state"], found["cut.mcap.part"]["state"]) == ("being written",
                                                                                  "cut: omnid log recover")
    answer = server.request(f"/recordings/{found['<b>??.mcap']['key']}/report", "POST", server.bearer)
    text = json.loads(answer.text)["text"]
    assert answer.status == 409 and text.startswith("omnid: ") and "Traceback" not in text
    with ThreadPoolExecutor(2) as threads:
        path = f"/recordings/{found['images_20261122T050000Z_001.mcap']['key']}/report"
        answers = list(threads.map(lambda _: server.request(path, "POST", server.bearer).text, range(2)))
    assert sum("another report is being made" in answer for answer in answers) == 1, answers
    assert sum('"text":"omnid: ' in answer for answer in answers) == 1, "it has no poses"
    missing = server.request("/recordings/0123/report", "POST", server.bearer)
    assert missing.status == 409 and "not there" in missing.text
