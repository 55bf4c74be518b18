"""The page in a real browser: `apt-get install chromium`, `pip install playwright`, `python -m pytest -m browser`.

Screenshots are written to the folder OMNID_SCREENSHOTS, if that is set.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, PoseAttachment, scan_cdr, string_from_cdr
from omnid.transport.status_names import CALIBRATION, NAVIGATION, WHEELS, Key
from omnid.transport.topics import Answer, Request
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry
from tests.omnid.web.servers import WebServer, served
from tests.replay.live import started
from tests.waiting import PATIENCE_S, wait_until

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [pytest.mark.browser, pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")]
SIZES = {"phone": (390, 844), "laptop": (1280, 800), "desk": (1366, 768)}
# What drives the robot is on the screen without scrolling; routes are beside it, on a phone below.
CONTROLS = ("arm", "goal", "stick", "fit")
HOSTILE = "<img src=x onerror=document.title='hacked'><script>document.title='hacked'</script>"
WAIT_MS = 20_000

# A page of another site that tries everything; the browser sends the cookie along where its rules allow that.
EVIL = """<!DOCTYPE html><title>evil</title><form id="form" method="post" action="http://HOST/stop"
 target="frame"></form>
<iframe name="frame"></iframe><iframe src="http://HOST/"></iframe><img src="http://HOST/metrics">
<script src="http://HOST/static/page.js"></script><script>
const tries = [fetch("http://HOST/stop", {method: "POST", mode: "no-cors", credentials: "include"}),
  fetch("http://HOST/arm", {method: "POST", mode: "no-cors", credentials: "include", body: "x"}),
  fetch("http://HOST/metrics", {credentials: "include"}).then((answer) => answer.text())];
let opened = "no";
fetch("http://HOST/live?seen=0", {credentials: "include"}).then(() => { opened = "yes"; });
document.getElementById("form").submit();
Promise.allSettled(tries).then((results) => setTimeout(() => {
  document.title = `tried ${opened} ${results[2].status}`; }, 1000));
</script>"""


class Navigator:
    """A robot that grants every request about routes."""

    def __init__(self, bus: Bus) -> None:
        self._bus, self.asked, self.state = bus, list[str](), "driving"
        bus.subscribe_commands(self._receive)

    def _receive(self, request: Request) -> None:
        text = string_from_cdr(request.payload)
        self.asked.append(text)
        self._bus.answer({request.id: Answer(True, f"does {text}")})

    def publish(self) -> None:
        """Report the navigation, and that it is armed."""
        wheels = DiagnosticStatus(WHEELS, 0, "driving", {Key.ARMED: "1"})
        self._bus.publish("status", codec.diagnostics_cdr(time.time_ns(), [wheels]))
        values = {Key.STATE: self.state, "reason": "", "task": "route dock", "left_m": "3.5"}
        entry = DiagnosticStatus(NAVIGATION, 0, "", {str(key): value for key, value in values.items()})
        self._bus.publish("navigation", codec.diagnostics_cdr(time.time_ns(), [entry]))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as tools:
        found = tools.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@contextlib.contextmanager
def opened(browser: Any, server: WebServer, size: str = "desk", scheme: str = "light") -> Iterator[Any]:
    """Yield the page at a size; fail for errors in it and for requests to other hosts."""
    width, height = SIZES[size]
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, has_touch=size == "phone"
    )
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: problems.append(line.text) if "Content Security Policy" in line.text else None)
    page.on(
        "request",
        lambda request: problems.append(request.url) if not request.url.startswith(f"http://{server.host}/") else None,
    )
    page.goto(server.url)
    page.wait_for_function("() => document.getElementById('state').textContent !== 'connecting'", timeout=WAIT_MS)
    try:
        yield page
        assert problems == []
    except BaseException:
        screenshot(page, "failed")
        raise
    finally:
        context.close()


def screenshot(page: Any, name: str) -> None:
    """Write a screenshot of the page."""
    if folder := os.environ.get("OMNID_SCREENSHOTS"):
        Path(folder).mkdir(exist_ok=True)
        page.screenshot(path=f"{folder}/{name}.png")


def shows(page: Any, element: str, text: str) -> None:
    """Wait until an element holds a text."""
    page.wait_for_function(
        "([id, text]) => document.getElementById(id).textContent.includes(text)", arg=[element, text], timeout=WAIT_MS
    )


def arm(page: Any, press: Callable[..., None]) -> None:
    """Press the button until the robot is armed: between two presses a busy machine may take longer than it waits."""
    end_s = time.monotonic() + PATIENCE_S
    while page.inner_text("#armed") != "armed":
        assert time.monotonic() < end_s, page.inner_text("#answer")
        with contextlib.suppress(Exception):  # the button goes when the robot is armed
            press("#arm", timeout=1000)
        page.wait_for_timeout(300)


def expect_it_fits(page: Any, size: str) -> None:
    """Expect no horizontal scrolling, and the stop button on the screen, big enough for a thumb, below the controls."""
    width, height = SIZES[size]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    box = page.locator("#stop").bounding_box()
    assert box["height"] >= 80 and box["width"] >= 0.9 * width
    assert box["x"] >= 0 and box["y"] + box["height"] <= height and box["x"] + box["width"] <= width
    page.evaluate("window.scrollTo(0, 0)")
    for name in CONTROLS:
        if control := page.locator(f"#{name}").bounding_box():  # it may be hidden
            assert 0 <= control["y"] <= control["y"] + control["height"] <= box["y"], name


def test_obstacles_and_the_coverage_of_a_calibration_are_shown(browser: Any) -> None:
    endpoint = free_endpoint()
    ranges = (1.5 + np.abs(np.sin(np.linspace(0, 9, 360)))).astype(np.float32)
    digits = "".join(str(number % 5) for number in range(36))
    coverage = {
        "pairs": "7",
        "needed": "15",
        "lower_coverage": digits,
        "upper_coverage": digits[::-1],
        "missing": "8 more positions; both cameras: no board at 1 to 4 o'clock",
    }
    calibration = DiagnosticStatus(CALIBRATION, 0, "hold it still", coverage)
    with contextlib.ExitStack() as ends:
        bus = ends.enter_context(contextlib.closing(Bus(BusConfig(listen=(endpoint,)))))
        server = ends.enter_context(served("--connect", endpoint))
        for size in SIZES:
            with opened(browser, server, size) as page:
                end_s = time.monotonic() + PATIENCE_S
                while not (
                    "nearest obstacle" in page.inner_text("#pose")
                    and page.locator("#calibration-upper path.seen").count()
                ):
                    assert time.monotonic() < end_s
                    pose = PoseAttachment(8, "tracking", 0, 50, 60, time.time_ns())
                    bus.publish("odom", odometry(8), pose.to_bytes())
                    bus.publish("scan", scan_cdr(10**9 + 8, "base_link", ranges, ranges, (0.1, 6.0)))
                    bus.publish("status", codec.diagnostics_cdr(10**18, [calibration]))
                    page.wait_for_timeout(100)
                assert page.locator("#calibration-lower path").count() == 36
                assert page.locator("#calibration-lower path.none").count() == digits.count("0")
                shows(page, "calibration-pairs", "7 of 15 pairs: hold it still")
                shows(page, "pose", "1.50 m")
                expect_it_fits(page, size)
                screenshot(page, f"{size}-calibration")


def test_routes_are_taught_and_repeated(browser: Any) -> None:
    endpoint = free_endpoint()
    with contextlib.ExitStack() as ends:
        bus = ends.enter_context(contextlib.closing(Bus(BusConfig(listen=(endpoint,)))))
        navigator = Navigator(bus)
        bus.publish("odom", odometry(8), PoseAttachment(8, "tracking", 0, 50, 60, time.time_ns()).to_bytes())
        server = ends.enter_context(served("--connect", endpoint))
        publishing = threading.Event()
        thread = threading.Thread(
            target=lambda: [navigator.publish() for _ in iter(lambda: publishing.wait(0.1), True)]
        )
        thread.start()
        ends.callback(thread.join)
        ends.callback(publishing.set)
        with opened(browser, server, "phone") as page:
            navigator.state = "driving"
            shows(page, "navigation", "route dock: driving, 3.5 m left")
            buttons = {name: page.locator(f"#route-{name}") for name in ("teach", "repeat", "stop", "pause", "resume")}
            page.wait_for_function("() => !document.getElementById('route-pause').disabled", timeout=WAIT_MS)
            assert [name for name, button in buttons.items() if button.is_enabled()] == ["repeat", "stop", "pause"]
            navigator.state = "idle"
            page.wait_for_function("() => document.getElementById('route-pause').disabled", timeout=WAIT_MS)
            assert [name for name, button in buttons.items() if button.is_enabled()] == ["teach", "repeat"]
            count = len(navigator.asked)
            page.fill("#route-name", "../x")
            page.click("#route-teach")
            page.fill("#route-name", "dock 1")
            page.click("#route-repeat")
            assert len(navigator.asked) == count
            page.fill("#route-name", "dock-1")
            page.click("#route-teach")
            shows(page, "route-answer", "does teach dock-1")
            page.click("#route-repeat")
            assert navigator.asked[-1] == "teach dock-1", "one press only asks"
            page.click("#route-repeat")
            wait_until(lambda: navigator.asked[-1] == "repeat dock-1", "the repetition")
            page.locator("#navigation-box").scroll_into_view_if_needed()
            expect_it_fits(page, "phone")
            screenshot(page, "phone-routes")


def heading_deg(page: Any) -> float:
    """Return the heading that the page shows."""
    return float(page.inner_text("#pose tr:nth-child(2) td:last-child").rstrip("\N{DEGREE SIGN}"))


def position(page: Any) -> tuple[float, float]:
    """Return x and y [m] that the page shows."""
    x, y, _ = page.inner_text("#pose tr:first-child td:last-child").removesuffix(" m").split(", ")
    return float(x), float(y)


def held(page: Any, until: Callable[[], object], what: str) -> None:
    """Wait with the page alive until something happens."""
    end_s = time.monotonic() + PATIENCE_S
    while not until():
        assert time.monotonic() < end_s, f"{what}: {page.inner_text('#pose')} {page.inner_text('#answer')}"
        page.wait_for_timeout(50)


def rests(page: Any) -> bool:
    """True if the robot has not moved for a while."""
    before = position(page)
    page.wait_for_timeout(700)
    return position(page) == pytest.approx(before, abs=0.005)


@pytest.mark.parametrize(("size", "scheme"), [("phone", "light"), ("desk", "dark")])
def test_stick_keys_and_a_tap_drive_a_simulated_robot(browser: Any, size: str, scheme: str) -> None:
    endpoint = free_endpoint()
    command = [
        *(sys.executable, "-m", "omnid", "simulate", "room", "--no-people", "--size", "320"),
        *("--set", f'bus.listen=["{endpoint}"]'),
        *("--set", "live.status_s=0.5"),
        *("--set", "controller.collision.unknown=slow"),
    ]  # such small images show little of the floor
    with (
        started(command, 0) as daemon,
        served("--connect", endpoint) as server,
        opened(browser, server, size, scheme) as page,
    ):
        shows(page, "state", "tracking")
        shows(page, "well", "All is well. Arm it to drive.")
        assert page.locator("#goal").is_disabled() and page.get_attribute("#stick", "aria-disabled") == "true"
        page.wait_for_function("() => document.getElementById('panorama').naturalWidth > 100", timeout=WAIT_MS)
        assert page.locator("#panorama").bounding_box()["width"] >= 0.95 * SIZES[size][0]
        press = page.tap if size == "phone" else page.click
        press("#arm")
        shows(page, "armed", "not armed")  # one press only asks
        arm(page, press)
        shows(page, "well", "All is well. It obeys commands.")
        # 1. The stick, released outside of it.
        box = page.locator("#stick").bounding_box()
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0], box["y"] + 4)
        held(page, lambda: position(page)[0] > 0.15, "motion by the stick")
        screenshot(page, f"{size}-stick")
        page.mouse.move(middle[0], 5)
        page.mouse.up()
        held(page, lambda: rests(page), "the stop")
        shows(page, "answer", "the stick is released")
        # 2. The keys; a page that loses the focus has released them.
        before = heading_deg(page)
        # A page that was without news for a moment has released the key; one that is held is pressed again.
        held(page, lambda: page.keyboard.down("ArrowLeft") or heading_deg(page) > before + 5, "a turn by the key")
        page.evaluate("window.dispatchEvent(new Event('blur'))")
        held(page, lambda: rests(page), "the stop")
        page.keyboard.up("ArrowLeft")
        # 3. A tap shows where it would drive; nothing moves before Go.
        x, y = position(page)
        page.click("#goal")
        plan = page.locator("#plan").bounding_box()
        page.mouse.move(plan["x"] + 0.5 * plan["width"], plan["y"] + 0.4 * plan["height"])
        page.mouse.down()
        page.mouse.move(plan["x"] + 0.5 * plan["width"] + 50, plan["y"] + 0.4 * plan["height"])
        page.mouse.up()
        shows(page, "answer", "Go drives there, around obstacles.")
        assert position(page) == pytest.approx((x, y), abs=0.02)
        screenshot(page, f"{size}-goal")
        page.click("#goal-go")
        shows(page, "answer", "accepted; navigation: driving")
        held(page, lambda: math.dist(position(page), (x, y)) > 0.1, "the drive to the goal")
        page.click("#goal-leave")
        shows(page, "answer", "cancelled")
        # 4. Stops, by the button and by a key.
        press("#stop")
        shows(page, "stop-answer", "the robot stops")
        shows(page, "armed", "not armed")
        arm(page, press)
        page.keyboard.press("Space")  # the focus is on the button Arm
        shows(page, "stop-answer", "the robot stops")
        shows(page, "armed", "not armed")
        expect_it_fits(page, size)
        assert daemon.end()[0] == 0


def test_text_of_the_robot_is_never_html(browser: Any) -> None:
    endpoint = free_endpoint()
    with (
        contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus,
        served("--connect", endpoint) as server,
        opened(browser, server) as page,
    ):
        entries = [DiagnosticStatus(f"{HOSTILE}{number}", 2, HOSTILE, {HOSTILE: HOSTILE}) for number in range(3)]
        entries.append(DiagnosticStatus(CALIBRATION, 0, HOSTILE, {"missing": HOSTILE}))
        end_s = time.monotonic() + 20
        while "onerror" not in page.inner_text("#warnings") or "script" not in page.text_content("#calibration-box"):
            assert time.monotonic() < end_s
            bus.publish("status", codec.diagnostics_cdr(10**18, entries))
            bus.publish("odom", odometry(1), PoseAttachment(1, HOSTILE, 0, 1, 1, 1).to_bytes())
            page.wait_for_timeout(100)
        shows(page, "state", "onerror")
        assert page.locator("main img:not(#panorama), main script").count() == 0
        assert page.title().startswith("omnid: ")  # "hacked" if any of it had run
        expect_it_fits(page, "desk")
        screenshot(page, "hostile")


@pytest.mark.hazard("H46")
def test_a_server_that_goes_is_noticed_and_found_again(browser: Any, tmp_path: Path) -> None:
    token = tmp_path / "token"
    with contextlib.ExitStack() as ends:
        first = ends.enter_context(served("--connect", free_endpoint(), "--token-file", token))
        page = ends.enter_context(opened(browser, first, "phone"))
        shows(page, "warnings", "cannot reach")
        first.process.kill()
        shows(page, "lost", "No connection")
        page.tap("#stop")
        shows(page, "stop-answer", "STOP IS NOT SENT: use the emergency stop")
        expect_it_fits(page, "phone")
        screenshot(page, "phone-gone")
        ends.enter_context(served("--connect", free_endpoint(), "--token-file", token, "--listen", first.host))
        page.wait_for_function("() => document.getElementById('lost').hidden", timeout=WAIT_MS)
        shows(page, "warnings", "cannot reach")


@pytest.mark.hazard("H45")
def test_another_site_in_the_same_browser_can_do_nothing(browser: Any) -> None:
    endpoint, commands = free_endpoint(), list[str]()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus, served("--connect", endpoint) as server:
        bus.subscribe_commands(lambda request: commands.append(request.topic))

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "text/html")
                self.end_headers()
                self.wfile.write(EVIL.replace("HOST", server.host).encode())

            def log_message(self, *_: object) -> None:
                pass

        with contextlib.ExitStack() as ends:
            site = HTTPServer(("127.0.0.1", 0), Handler)
            ends.callback(site.server_close)
            thread = threading.Thread(target=site.serve_forever)
            thread.start()
            ends.callback(thread.join)
            ends.callback(site.shutdown)
            context = browser.new_context()
            ends.callback(context.close)
            page = context.new_page()
            page.goto(server.url)
            shows(page, "robot", "omnid")
            for host in ("127.0.0.1", "localhost"):  # the same site on another port, and another site
                evil = context.new_page()
                evil.goto(f"http://{host}:{site.server_port}/")
                evil.wait_for_function("() => document.title.startsWith('tried')", timeout=WAIT_MS)
                assert evil.title() == "tried no rejected"
        assert commands == []
