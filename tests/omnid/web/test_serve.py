"""The server in the process of the tests: its names, addresses, signals, and connections that send no request."""

from __future__ import annotations

import http.client
import ipaddress
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import pytest

from omnid.errors import OmnidError
from omnid.transport.bus import Bus, BusConfig
from omnid.web import server
from omnid.web.access import Access, new_token
from omnid.web.guard import Guard
from omnid.web.server import WebSettings, _address, _check_names, _listening, _print_addresses, _uvicorn_config, serve
from tests.omnid.web.servers import Shown, WebServer
from tests.ports import free_port
from tests.replay.live import answers
from tests.waiting import PATIENCE_S, wait_until


@pytest.fixture
def kept_signals() -> Iterator[None]:
    """Let no signal of these tests end the process, and restore the handlers."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGTERM, lambda *_: None)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def run(
    client: Callable[[WebServer], None], endpoint: str, token_file: Path, host: str = "127.0.0.1", **settings: Any
) -> None:
    """Serve, let a client use it in a thread, and end it by a signal."""
    token_file.write_text(new_token())
    token_file.chmod(0o600)
    port, failures, ended = free_port(), list[BaseException](), threading.Event()

    def use() -> None:
        try:
            wait_until(lambda: ended.is_set() or answers(port))
            client(WebServer(cast("Any", None), f"http://127.0.0.1:{port}/?token={token_file.read_text()}"))
        except BaseException as failure:
            failures.append(failure)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=use)
    thread.start()
    try:
        serve(
            BusConfig(connect=(endpoint,)),
            WebSettings(listen=f"{host}:{port}", token_file=token_file, **settings),
        )
    finally:
        ended.set()
        thread.join()
    if failures:
        raise failures[0]
    assert not answers(port)


def test_a_local_server_answers_to_its_names_until_a_signal(
    bus: Bus,
    endpoint: str,
    tmp_path: Path,
    kept_signals: None,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as with nohup
    shown = list[str]()

    def client(web: WebServer) -> None:
        for name, status in (
            ("localhost", 200),
            (f"127.0.0.1:{web.port}", 200),
            ("[::1]", 200),
            ("Robot.Example", 200),
            (socket.gethostname(), 403),
            ("192.168.1.7", 403),
            ("evil.example", 403),
        ):
            assert web.request("/metrics", headers={**web.bearer, "Host": name}).status == status, name
        cookie = web.request(f"/?token={web.token}").headers["set-cookie"]
        assert cookie.startswith(f"omnid_{web.port}=") and "secure" not in cookie.lower()
        os.kill(os.getpid(), signal.SIGINT)
        assert web.request("/metrics", headers=web.bearer).status == 200, "an ignored signal does not end it"
        shown.append(f"http://127.0.0.1:{web.port}/?token={web.token}\n")

    with caplog.at_level(logging.WARNING):
        run(client, endpoint, tmp_path / "token", names=("ROBOT.example",))
    assert "without encryption" not in caplog.text and capsys.readouterr().out == shown[0]


def test_a_server_on_the_network_warns_and_answers_to_the_name_of_the_machine(
    bus: Bus,
    endpoint: str,
    tmp_path: Path,
    kept_signals: None,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "stop").write_text("abcdefghijklmnop")
    (tmp_path / "stop").chmod(0o600)

    def client(web: WebServer) -> None:
        name = socket.gethostname()
        for host, status in ((name, 200), (f"{name}.local", 200), ("192.168.1.7", 200), ("evil.example", 403)):
            assert web.request("/metrics", headers={**web.bearer, "Host": host}).status == status, host
        stop_only = {"Authorization": "Bearer abcdefghijklmnop"}
        assert web.request("/arm", "POST", stop_only).status == 403

    with caplog.at_level(logging.WARNING):
        run(client, endpoint, tmp_path / "token", "0.0.0.0", stop_token_file=tmp_path / "stop")
    assert "without encryption" in caplog.text
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and lines[1].endswith("?token=abcdefghijklmnop (may see and stop, not arm)")


def test_connections_without_a_whole_request_are_closed_and_others_stay(
    bus: Bus, endpoint: str, tmp_path: Path, kept_signals: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "REQUEST_S", 1.0)  # longer than a busy machine takes for a request

    def closed(connection: socket.socket) -> bool:
        while data := connection.recv(65_536):
            assert not data.startswith(b"HTTP/1.1 2")
        return True

    def client(web: WebServer) -> None:
        with ExitStack() as stack:
            used = http.client.HTTPConnection("127.0.0.1", web.port, timeout=PATIENCE_S)
            stack.callback(used.close)
            live = stack.enter_context(web.live(web.bearer))
            used.request("GET", "/", headers=web.bearer)
            assert used.getresponse().read()
            half = stack.enter_context(socket.create_connection(("127.0.0.1", web.port), timeout=PATIENCE_S))
            half.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")
            assert closed(half), "a connection with half a request"
            Shown(live).until("state")  # later than its own limit
            used.request("GET", "/", headers=web.bearer)
            assert used.getresponse().read(), "a connection that has sent a request"
            assert used.sock is not None
            used.sock.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: ")
            assert closed(used.sock), "half a request after a whole one"

    run(client, endpoint, tmp_path / "token")


def test_settings_that_cannot_be_used_are_refused_before_anything_is_served(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("abcdefghijklmnop")
    token.chmod(0o600)
    (tmp_path / "no.pem").write_text("nothing")
    (tmp_path / "same").write_text("abcdefghijklmnop")
    (tmp_path / "same").chmod(0o600)
    for settings, words in (
        (WebSettings("127.0.0.1:0", token, tmp_path / "same"), "--stop-token-file has the token"),
        (WebSettings("127.0.0.1:0", token, names=("good", "http://x")), "--host http://x"),
        (WebSettings("127.0.0.1:0", token, tls=(tmp_path / "no.pem", tmp_path / "none")), "--tls-key"),
        (WebSettings("127.0.0.1:0", token, tls=(tmp_path / "none", tmp_path / "no.pem")), "--tls-certificate"),
        (WebSettings("127.0.0.1:0", token, tls=(tmp_path / "no.pem", tmp_path / "no.pem")), "in PEM"),
    ):
        with pytest.raises(OmnidError, match=words):
            serve(BusConfig(), settings)
    _check_names(("robot.example", "[fe80::1]", "a-b_c"))


@pytest.mark.parametrize("listen", ["127.0.0.1:65536", "127.0.0.1:99999", "localhost", "a b:1", ":1", "127.0.0.1:"])
def test_other_addresses_are_refused(listen: str) -> None:
    with pytest.raises(OmnidError, match="HOST:PORT"), _listening(listen):
        pass


def test_it_listens_at_any_port_of_an_address() -> None:
    with _listening("127.0.0.1:0") as listener:
        host, port = listener.getsockname()
        assert host == "127.0.0.1" and port
        assert listener.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT) >= server.SILENCE_S
        with pytest.raises(OmnidError, match="stop the other program"), _listening(f"127.0.0.1:{port}"):
            pass
    try:
        with _listening("127.0.0.1:65535") as listener:
            assert listener.getsockname()[1] == 65535
    except OmnidError as error:
        assert "the other program" in str(error)


def test_the_address_that_is_printed_can_be_opened_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    assert _address("192.168.1.7") == "192.168.1.7" and _address("fe80::1") == "[fe80::1]"
    for every in ("0.0.0.0", "::"):
        found = _address(every)
        assert found == socket.gethostname() or not ipaddress.ip_address(found).is_unspecified
    _print_addresses("http://a/", "one", "")
    assert capsys.readouterr().out == "http://a/?token=one\n"


def test_the_server_trusts_no_header_and_bounds_what_a_browser_sends() -> None:
    async def app(*_: object) -> None:
        pass

    config = _uvicorn_config(Guard(app, Access("abcdefghijklmnop", frozenset(), False, "omnid", "")), WebSettings())
    assert not config.proxy_headers and not config.server_header and not config.access_log
    assert config.ws_max_size == server.LONGEST_MESSAGE and not config.ws_per_message_deflate
    assert config.timeout_graceful_shutdown == server.END_S and config.ws_ping_interval is None
