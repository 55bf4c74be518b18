"""The server as a process: who is let in, what browsers get, and what hostile ones cannot do."""

from __future__ import annotations

import http.client
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

pytest.importorskip("starlette", reason="needs the packages of omnid[web]")
from starlette.requests import HTTPConnection

from omnid.errors import OmnidError
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, PoseAttachment
from omnid.transport.status_names import BUS, CALIBRATION, WHEELS
from omnid.web.server import Access, Role, token_of
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.omnid.web.servers import Shown, WebServer, served
from tests.replay.command import Command
from tests.waiting import PATIENCE_S, wait_until

HOSTILE = "<img src=x onerror=alert(1)>\x1b[2J\u202e\x00\n"


def publish(bus: Bus, seq: int, state: str = "tracking") -> None:
    bus.publish("odom", odometry(seq), PoseAttachment(seq, state, 0, 50, 60, time.time_ns()).to_bytes())


def test_the_printed_address_lets_a_browser_in(server: WebServer) -> None:
    first = server.request("/")
    assert first.status == 401 and "token" in first.text and "page.js" not in first.text
    assert server.request("/?token=wrong").status == 401
    page = server.request("/", headers=server.cookie())
    assert page.status == 200 and "page.js" in page.text
    cookie = server.request(f"/?token={server.token}").headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=lax" in cookie


@pytest.mark.parametrize("path", ["/", "/static/page.js"])
def test_every_answer_has_the_headers_that_protect_the_page(server: WebServer, path: str) -> None:
    for headers in ({}, server.bearer):
        answer = server.request(path, headers=headers)
        assert "script-src 'self'" in answer.headers["content-security-policy"]
        assert "unsafe" not in answer.headers["content-security-policy"]
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "same-origin"
        assert server.token not in answer.text


@pytest.mark.hazard("H45")
@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("POST", "/stop"),
        ("POST", "/arm"),
        ("GET", "/live?seen=0"),
    ],
)
def test_nothing_is_answered_without_token_or_for_another_site(server: WebServer, method: str, path: str) -> None:
    origin = {"Origin": f"http://{server.host}"}
    assert server.request(path, method, origin).status == 401
    assert server.request(path, method, {"Authorization": "Bearer wrong"}).status == 401
    assert server.request(path, method, {**server.cookie(), "Origin": "http://evil.example"}).status == 403
    assert server.request(path, method, {**server.bearer, "Host": "evil.example"}).status == 403


@pytest.mark.parametrize("query", ["", "seen=-1", "seen=" + "9" * 40])
def test_news_since_no_version_are_refused(server: WebServer, query: str) -> None:
    assert server.request(f"/live?{quote(query, safe='=')}", headers=server.bearer).status == 400


def test_news_since_a_version_of_another_server_are_all_of_them(server: WebServer, bus: Bus) -> None:
    bus.publish("path", codec.path_cdr(10**18, "odom", [(0.0, 0.0)]))
    Shown(server).until("path", lambda: publish(bus, 3))
    for seen in (0, 5, 10**15 - 1):
        news = json.loads(server.request(f"/live?seen={seen}", headers=server.bearer).text)
        assert news["path"] == [[0.0, 0.0]] and "state" in news


def test_poses_status_and_map_arrive(server: WebServer, bus: Bus) -> None:
    seq = count(1)
    grid = np.full((40, 30), -1, np.int8)
    grid[:, 0], grid[0, :] = 100, 0
    wheels = DiagnosticStatus(WHEELS, 1, "not armed: a stop was asked for", {"remedy": "omnid arm", "armed": "0"})

    def run() -> None:
        publish(bus, next(seq))
        bus.publish("status", codec.diagnostics_cdr(10**18, [DiagnosticStatus(BUS, 0, "open", {"lost": "0"}), wheels]))
        bus.publish("map", codec.grid_cdr(10**18, "odom", grid, 0.1, (-1.0, -2.0)))

    shown = Shown(server)
    state = shown.until("state", run, lambda found: found["pose"] and found["wheels"] and found["alive"])
    assert state["state"] == "tracking" and state["pose"]["inliers"] == 50 and not state["wheels"]["armed"]
    assert state["warnings"] == [
        {"level": 1, "name": "wheels", "message": "not armed: a stop was asked for", "remedy": "omnid arm"}
    ]
    received = shown.until("map", run, lambda found: found["width"])
    cells = np.frombuffer(zlib.decompress(server.image("map")), np.uint8).reshape(40, 30)
    assert (cells[1:, 0] == 2).all() and (cells[0, 1:] == 1).all() and (cells[1:, 1:] == 0).all()
    assert (received["cell_m"], received["x_m"], received["y_m"]) == (pytest.approx(0.1), -1.0, -2.0)
    other = codec.grid_cdr(10**18, "elsewhere", grid, 0.1, (0.0, 0.0))
    received = shown.until("map", lambda: bus.publish("map", other), lambda found: found["frame"] == "elsewhere")
    assert (received["width"], server.image("map")) == (0, b"")


@pytest.mark.hazard("H46")
def test_a_stop_is_repeated_until_the_status_confirms_it(server: WebServer, bus: Bus) -> None:
    received, is_stopped = list[str](), [False]
    bus.subscribe_commands(lambda request: received.append(request.topic), lambda: is_stopped[0])
    with ThreadPoolExecutor(2) as threads:
        answers = [threads.submit(server.post, "/stop") for _ in range(2)]
        wait_until(lambda: received.count("cmd/stop") >= 5)
        assert not any(answer.done() for answer in answers) and not server.arm()["done"]
        is_stopped[0] = True
        assert all(answer.result()["done"] for answer in answers) and "cmd/arm" not in received


def strings(value: Any) -> Iterator[str]:
    """Yield all texts in a JSON value."""
    if isinstance(value, dict):
        yield from strings([*value, *value.values()])
    elif isinstance(value, list):
        for part in value:
            yield from strings(part)
    elif isinstance(value, str):
        yield value


def test_hostile_messages_of_the_robot_are_shown_as_text(server: WebServer, bus: Bus) -> None:
    values = {HOSTILE: HOSTILE, **{f"key {number}": "9" * 500 for number in range(200)}}
    entries = [DiagnosticStatus(f"{HOSTILE}{number}", 2, HOSTILE * 100, values) for number in range(5)]
    entries.append(DiagnosticStatus(CALIBRATION, 0, HOSTILE, values))
    huge = json.dumps({"seq": 10**300, "sent_ns": 10**400, "state": HOSTILE, "inliers": -(10**200)}).encode()

    def run() -> None:
        bus.publish("status", codec.diagnostics_cdr(10**18, entries))
        bus.publish("odom", odometry(5), huge)
        bus.publish("odom", b"nonsense")
        bus.publish("map", b"\0" * 1000)
        bus.publish("panorama", b"\0" * 1000)

    shown = Shown(server)
    broken = shown.until("state")["broken"]
    state = shown.until("state", run, lambda found: len(found["warnings"]) >= 5 and found["broken"] > broken + 1)
    parts = shown.until("parts", run, lambda found: len(found) == 1)
    for text in (json.dumps(state), json.dumps(parts)):
        assert "onerror" in text and len(text) < 400_000
    assert all(text.isprintable() for text in (*strings(state), *strings(parts)))
    metrics = server.request("/metrics", headers=server.bearer).text
    assert "\x1b" not in metrics and all(line.startswith("omnid_") for line in metrics.splitlines())


@pytest.mark.hazard("H51")
@pytest.mark.parametrize("first", [b"", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: "])
def test_two_thousand_silent_connections_keep_no_stop_out(server: WebServer, bus: Bus, first: bytes) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 4096)), hard))
    bus.subscribe_commands(lambda _: None, lambda: True)
    with ExitStack() as crowd:
        for _ in range(2000):
            silent = crowd.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            silent.sendall(first)
        assert server.post("/stop")["done"]
        assert Shown(server).until("state")


def test_without_a_robot_the_page_says_so_and_a_stop_is_not_confirmed(default_signals: None) -> None:
    with served("--connect", free_endpoint()) as server:
        state = Shown(server).until("state", holds=lambda found: "cannot reach" in found["link"])
        assert state["warnings"][0]["name"] == "connection"
        assert server.arm()["text"].startswith("There is no connection")
        assert server.post("/stop")["text"].startswith("the stop is NOT confirmed: use the emergency stop")
        assert server.end(signal.SIGINT) == (0, "")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--listen", "nonsense"), "HOST:PORT"),
        (("--listen", "192.0.2.1:0"), "free port"),
        (("--listen", "127.0.0.1:70000"), "HOST:PORT"),
    ],
)
def test_wrong_options_are_refused(words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    listen = () if "--listen" in words else ("--listen", "127.0.0.1:0")
    assert expected in Command(capsys).refused("web", *listen, *words)


def test_the_journal_gets_no_token(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    status = os.fstat(writer)
    environment = os.environ | {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
    command = [sys.executable, "-m", "omnid", "web", "--listen", "127.0.0.1:0", "--connect", free_endpoint()]
    refused = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, env=environment, text=True)
    assert refused.returncode == 2 and "the journal would keep it: name a --token-file" in refused.stderr
    token = tmp_path / "token"
    with (
        os.fdopen(reader) as journal,
        subprocess.Popen(
            [*command, "--token-file", token], stdout=writer, stderr=subprocess.DEVNULL, env=environment
        ) as process,
    ):
        line = journal.readline()
        process.kill()
        os.close(writer)
        assert "(the token is in the file of --token-file)" in line and "token=" not in line
        assert token.read_text().strip() not in line + journal.read()


def token_file(folder: Path, name: str, text: str = "abcdefghijklmnop") -> Path:
    path = folder / name
    path.write_text(text)
    path.chmod(0o600)
    return path


def test_on_the_network_a_warning_says_that_the_token_can_be_read(tmp_path: Path) -> None:
    words = ("--host", "Robot.Example", "--stop-token-file", token_file(tmp_path, "stop"))
    with served("--connect", free_endpoint(), "--listen", "0.0.0.0:0", *words) as server:
        assert server.process.stdout is not None
        own = ("192.168.1.7", "robot.example", socket.gethostname(), f"{socket.gethostname()}.local")
        for host, status in (*((name, 200) for name in own), ("evil.example", 403)):
            assert server.request("/metrics", headers={**server.bearer, "Host": host}).status == status
        assert server.request("/arm", "POST", {"Authorization": "Bearer abcdefghijklmnop"}).status == 403
        assert server.process.stdout.readline().endswith("?token=abcdefghijklmnop (may see and stop, not arm)\n")
        code, err = server.end()
        assert code == 0 and "without encryption" in err and err.count("\n") == 1


def test_a_signal_ends_the_server_with_pages_open() -> None:
    with served("--connect", free_endpoint()) as server, ThreadPoolExecutor(1) as threads:
        Shown(server).until("state")
        asking = threads.submit(lambda: [Shown(server).read() for _ in range(1000)])
        begin_s = time.monotonic()
        assert server.end() == (0, "")
        assert time.monotonic() - begin_s < PATIENCE_S
        with pytest.raises((OSError, http.client.HTTPException, AssertionError)):
            asking.result()


def test_a_page_that_is_opened_after_a_drive_has_its_path() -> None:
    endpoint, way = free_endpoint(), [[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]]
    with ExitStack() as ends:
        bus = ends.enter_context(closing(Bus(BusConfig(listen=(endpoint,)))))
        bus.publish("path", codec.path_cdr(10**18, "odom", way))
        server = ends.enter_context(served("--connect", endpoint))

        def shown() -> object:
            news = json.loads(server.request("/live?seen=0", headers=server.bearer).text)
            return news.get("path")

        wait_until(lambda: shown() == way, "the path")


TOKEN, STOP_TOKEN = "abcde-fghjk-mnpqr-stuvw", "stop-stop-stop-stop"
LOCAL = Access(TOKEN, frozenset(("localhost", "127.0.0.1", "[::1]")), False, "omnid_8447")
NETWORK = Access(TOKEN, frozenset(("localhost", "rover", "rover.local")), True, "omnid_8447")
BOTH = Access(TOKEN, LOCAL.hosts, False, "omnid_8447", STOP_TOKEN)
HOST = "127.0.0.1:8447"
COOKIE = {"cookie": f"other=1; omnid_8447={TOKEN}"}
BEARER = {"authorization": f"Bearer {TOKEN}"}
OWN = {"origin": f"http://{HOST}"}


def reason(access: Access, *headers: dict[str, str], path: str = "/metrics", method: str = "GET") -> str:
    """Return the first words of a refusal, empty where the request enters; later headers replace earlier ones."""
    merged = {"host": HOST}
    for more in headers:
        merged |= more
    lines = [(name.encode(), value.encode("latin-1")) for name, value in merged.items() if value]
    scope = {"type": "http", "path": path, "headers": lines, "method": method}
    return access.refusal(HTTPConnection(scope)).partition(":")[0]


@pytest.mark.parametrize(
    ("access", "host", "enters"),
    [
        (LOCAL, HOST, True),
        (LOCAL, "[::1]:8447", True),
        (LOCAL, "evil.example", False),
        (LOCAL, "", False),
        (NETWORK, "192.168.1.7:8447", True),
        (NETWORK, "evil.example:8447", False),
    ],
)
def test_only_own_names_are_answered(access: Access, host: str, enters: bool) -> None:
    assert reason(access, BEARER, {"host": host}) == ("" if enters else "unknown host")


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({}, "no token"),
        (COOKIE, ""),
        (BEARER, ""),
        ({"authorization": "Bearer wrong-wrong-wrong"}, "wrong token"),
        ({**COOKIE, "authorization": "Bearer wrong"}, "wrong token"),
        ({"cookie": "omnid_8447=\xe4"}, "wrong token"),
        ({"cookie": f"omnid_8447={STOP_TOKEN}"}, "wrong token"),
        ({"cookie": f"omnid_1={TOKEN}"}, "no token"),
    ],
)
def test_the_token_or_its_cookie_is_needed(headers: dict[str, str], expected: str) -> None:
    assert reason(LOCAL, headers) == expected
    assert reason(LOCAL, headers, OWN, path="/live") == expected


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        (OWN, ""),
        ({"origin": "http://evil.example"}, "cross-site"),
        ({}, "no origin"),
        (BEARER, ""),
        ({**OWN, "sec-fetch-site": "same-origin"}, ""),
        ({**OWN, "sec-fetch-site": "cross-site"}, "cross-site"),
        ({**BEARER, "origin": "http://evil.example"}, "cross-site"),
    ],
)
def test_commands_come_from_the_own_page(headers: dict[str, str], expected: str) -> None:
    assert reason(LOCAL, COOKIE, headers, method="POST", path="/stop") == expected


@pytest.mark.parametrize(("path", "expected"), [("/", ""), ("/metrics", "cross-site"), ("/static/a.js", "cross-site")])
def test_other_sites_may_only_link_to_the_page(path: str, expected: str) -> None:
    assert reason(LOCAL, COOKIE, {"sec-fetch-site": "cross-site"}, path=path) == expected


def test_the_token_for_stops_may_see_and_stop_and_nothing_else() -> None:
    cookie = {"cookie": f"omnid_8447={STOP_TOKEN}", **OWN}
    for headers in ({"authorization": f"Bearer {STOP_TOKEN}"}, cookie):
        for path, method in (("/", "GET"), ("/metrics", "GET"), ("/stop", "POST")):
            assert reason(BOTH, headers, path=path, method=method) == ""
        assert reason(BOTH, headers, path="/live") == ""
        for path in ("/arm", "/route", "/navigation", "/map", "/drive", "/goal", "/x/stop"):
            assert reason(BOTH, headers, path=path, method="POST") == "stop only"
    assert reason(BOTH, COOKIE, OWN, path="/arm", method="POST") == ""
    assert BOTH.role_of(f" {TOKEN}\n") is Role.DRIVE and BOTH.role_of(STOP_TOKEN) is Role.STOP
    assert LOCAL.role_of("") is None, "without a token for stops an empty one is none"


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        (f"{TOKEN}\n", 0o604, "chmod 600"),
        ("has a space in it here\n", 0o600, "16 to 256"),
    ],
)
def test_unfit_token_files_are_refused(tmp_path: Path, text: str, mode: int, message: str) -> None:
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(OmnidError, match=message):
        token_of(path)
    with pytest.raises(OmnidError, match="cannot be used"):
        token_of(tmp_path / "missing" / "token")
