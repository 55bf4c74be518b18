"""Browsers: each gets the newest message of each kind, and one that sends or answers wrongly is closed."""

from __future__ import annotations

import asyncio
import json
from functools import partial
from typing import Any

import pytest
from starlette.websockets import WebSocket

from omnid.web import browsers as browsers_module
from omnid.web.browsers import MOST_BROWSERS, MOST_REQUESTS, Browsers
from omnid.web.channels import LivePath
from tests.omnid.web.test_feed import channels, until


class Page:
    """A browser: what it was sent, and what it sends."""

    def __init__(self, browsers: Browsers) -> None:
        self.sent: list[dict[str, Any]] = []
        self._events: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._events.put_nowait({"type": "websocket.connect"})
        scope = {"type": "websocket", "path": "/live", "headers": []}
        self.serving = asyncio.create_task(browsers.serve(WebSocket(scope, self._events.get, self._send)))

    async def _send(self, message: Any) -> None:
        self.sent.append(message)

    def say(self, text: str) -> None:
        self._events.put_nowait({"type": "websocket.receive", "text": text})

    def leave(self) -> None:
        self._events.put_nowait({"type": "websocket.disconnect", "code": 1000})

    @property
    def texts(self) -> list[str]:
        """The messages so far."""
        return [message["text"] for message in self.sent if message["type"] == "websocket.send"]

    @property
    def closed(self) -> int:
        """The code with which it was closed, 0 if it was not."""
        return int(self.sent[-1]["code"]) if self.sent and self.sent[-1]["type"] == "websocket.close" else 0


def shows(page: Page, text: str) -> bool:
    """True if the newest message of a browser has a text."""
    return bool(page.texts) and text in page.texts[-1]


def test_a_browser_gets_the_newest_message_of_each_kind_once_it_has_answered() -> None:
    async def check() -> None:
        state, extra = channels("state", "extra")
        browsers = Browsers((state, extra), frozenset(("extra",)))
        page = Page(browsers)
        await until(lambda: len(browsers) == 1)
        state.changed()
        extra.changed()
        browsers.notify()
        await until(lambda: page.texts)
        for _ in range(3):
            state.changed()
            browsers.notify()
        await asyncio.sleep(0)
        assert page.texts == ["state 1"] and not browsers.want("extra")
        page.say("ok")
        await until(lambda: len(page.texts) > 1)
        assert page.texts == ["state 1", "state 4"] and browsers.skipped == {"state": 2}
        page.say("show extra")
        page.say("ok")
        await until(lambda: len(page.texts) > 2)
        assert page.texts[2] == "extra 1" and browsers.want("extra") and browsers.sent == {"state": 2, "extra": 1}
        assert browsers.answer.count == 2 and browsers.answer.p(1.0) < 10.0
        page.say("hide extra")
        page.say("ok")
        await until(lambda: not browsers.want("extra"))
        extra.changed()
        state.changed()
        browsers.notify()
        await until(lambda: len(page.texts) > 3)
        assert page.texts[3] == "state 5"
        page.leave()
        await page.serving
        assert not len(browsers) and not page.closed and not browsers.closed

    asyncio.run(check())


@pytest.mark.parametrize("text", ["ok", "show state", "hide", "show", "arm", ""])
def test_a_browser_that_sends_what_no_page_sends_is_closed(text: str) -> None:
    async def check() -> None:
        browsers = Browsers(channels("state", "extra"), frozenset(("extra",)))
        page = Page(browsers)
        page.say(text)
        await page.serving
        assert page.closed == 1008 and browsers.closed == {"unexpected message": 1} and not len(browsers)

    asyncio.run(check())


def test_each_message_is_answered_once_and_points_of_the_path_are_never_skipped() -> None:
    async def check() -> None:
        path = LivePath()
        browsers = Browsers((path,))
        page = Page(browsers)
        for x_m in (0.0, 0.5, 1.0, 1.5):
            path.add(x_m, 0.0)
            if x_m != 0.5:
                browsers.notify()
                await until(partial(shows, page, f"[{x_m},"))
                page.say("ok")
                await until(lambda: page._events.empty())
        assert [json.loads(text)["from"] for text in page.texts] == [0, 1, 3] and not browsers.skipped
        page.say("ok")
        await page.serving
        assert page.closed == 1008

    asyncio.run(check())


def test_a_browser_may_ask_for_channels_so_many_times() -> None:
    async def check() -> None:
        browsers = Browsers(channels("extra"), frozenset(("extra",)))
        page = Page(browsers)
        for _ in range(MOST_REQUESTS):
            page.say("show extra")
        await until(lambda: page._events.empty())
        await asyncio.sleep(0)
        assert page.closed != 1008 and len(browsers) == 1
        page.say("show extra")
        await page.serving
        assert page.closed == 1008

    asyncio.run(check())


def test_a_browser_that_does_not_answer_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browsers_module, "ANSWER_S", 0.01)

    async def check() -> None:
        (state,) = channels("state")
        state.changed()
        browsers = Browsers((state,))
        page = Page(browsers)
        await until(lambda: page.closed)
        assert page.closed == 1001 and browsers.closed == {"no answer": 1}
        page.leave()
        await page.serving

    asyncio.run(check())


def test_no_more_browsers_than_places() -> None:
    async def check() -> None:
        browsers = Browsers(channels("state"))
        pages = [Page(browsers) for _ in range(MOST_BROWSERS)]
        await until(lambda: len(browsers) == MOST_BROWSERS)
        one_more = Page(browsers)
        await one_more.serving
        assert one_more.closed == 1013 and browsers.closed == {"too many browsers": 1}
        pages[0].leave()
        await pages[0].serving
        again = Page(browsers)
        await until(lambda: len(browsers) == MOST_BROWSERS)
        for page in (again, *pages[1:]):
            page.leave()
            await page.serving

    asyncio.run(check())
