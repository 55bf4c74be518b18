"""The STOP button: its script in node, with real requests to a server whose first connection is lost."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from omnid.web.server import STATIC

NODE = shutil.which("node")
PATIENCE_S = 30.0
# A document of elements that remember what is shown; it ends when the button shows an answer of the server.
PRESS = """
const shown = [];
const element = (id) => ({ classList: { add() {}, remove() {} }, addEventListener(name, act) { this[name] = act; },
  set textContent(text) { if (id === "stop-answer" && shown.at(-1) !== text) shown.push(text); } });
const elements = {};
globalThis.document = { getElementById: (id) => (elements[id] ??= element(id)), addEventListener() {} };
const send = fetch;
globalThis.fetch = (address, options) => send(`http://127.0.0.1:${process.argv[2]}/${address}`, options);
const { wireStop } = await import("./commands.js");
wireStop();
elements.stop.pointerdown();
setInterval(() => {
  if (!shown.at(-1)?.startsWith("the robot stops")) return;
  console.log(JSON.stringify(shown));
  process.exit(0);
}, 20);
"""


@pytest.mark.hazard("H46")
@pytest.mark.skipif(NODE is None, reason="needs node")
def test_a_stop_on_a_connection_that_is_lost_is_sent_on_another_one(tmp_path: Path) -> None:
    """A network that has gone ends no request for minutes: it gets no answer, and no error."""
    for script in ("commands.js", "elements.js"):
        shutil.copy(STATIC / script, tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "press.js").write_text(PRESS)
    asked, ended = list[str](), threading.Event()

    class Lossy(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.append(self.path)
            if len(asked) == 1:
                ended.wait(PATIENCE_S)
                return
            body = json.dumps({"done": True, "text": "the robot stops"}).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Lossy)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        found = subprocess.run(
            [str(NODE), str(tmp_path / "press.js"), str(server.server_port)],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=True,
        )
    finally:
        ended.set()
        server.shutdown()
        thread.join()
        server.server_close()
    first, *_, last = shown = json.loads(found.stdout)
    assert first == "sending STOP ..." and last == "the robot stops"
    assert any("use the emergency stop" in text for text in shown[1:-1]), "the operator is told meanwhile"
    assert len(asked) > 1 and set(asked) == {"/stop"}
