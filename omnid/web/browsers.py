"""The browsers that show the page: each gets the newest message of each kind, one at a time.

A browser answers each message, and gets the next one only then. What is published meanwhile is skipped, so a slow phone
sees the present state later, and never a queue of old ones; it delays no other browser.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from starlette.websockets import WebSocket, WebSocketDisconnect

from omnid.engine.telemetry import Histogram
from omnid.web.channels import BrowserChannel, Encoded, Newest

MOST_BROWSERS: Final = 32
ANSWER_S: Final = 10.0  # a browser that has not answered within that is disconnected
MOST_REQUESTS: Final = 1000  # Most requests for channels by one browser.
ANSWER: Final = "ok"
TRY_LATER, POLICY_VIOLATION, GOING_AWAY = 1013, 1008, 1001  # codes of RFC 6455


class _Browser:
    """One open page."""

    def __init__(self, channels: Sequence[BrowserChannel]) -> None:
        self.channels = list(channels)  # the one that was sent longest ago first
        self.seen: Counter[str] = Counter()
        self.wanted: set[str] = set()
        self.wake, self.answered = asyncio.Event(), asyncio.Event()
        self.waiting = False  # for an answer
        self.requests = 0

    def take(self, on_request: frozenset[str]) -> tuple[BrowserChannel, Encoded] | None:
        """Return the next message; None if the browser has seen all."""
        for channel in self.channels:
            if channel.version > self.seen[channel.name] and (
                channel.name not in on_request or channel.name in self.wanted
            ):
                self.channels.remove(channel)
                self.channels.append(channel)
                return channel, channel.message(self.seen[channel.name])
        return None


class Browsers:
    """All open pages. Counters: sent and skipped messages by channel, browsers refused or disconnected by reason."""

    def __init__(self, channels: Sequence[BrowserChannel], on_request: frozenset[str] = frozenset()) -> None:
        """on_request: names of channels that are sent only to browsers that ask for them."""
        self._channels, self._on_request = channels, on_request
        self._open: set[_Browser] = set()
        self.sent: Counter[str] = Counter()
        self.skipped: Counter[str] = Counter()
        self.closed: Counter[str] = Counter()
        self.answer = Histogram()  # s, from sending a message to the answer of the browser, which has drawn it

    def __len__(self) -> int:
        """Return the number of open pages."""
        return len(self._open)

    def notify(self) -> None:
        """Send what is new."""
        for browser in self._open:
            browser.wake.set()

    def want(self, name: str) -> bool:
        """True if a browser has asked for the channel."""
        return any(name in browser.wanted for browser in self._open)

    async def serve(self, websocket: WebSocket) -> None:
        """Send messages to a browser until it goes."""
        await websocket.accept()
        if len(self._open) >= MOST_BROWSERS:
            self.closed["too many browsers"] += 1
            await websocket.close(TRY_LATER, f"{MOST_BROWSERS} pages are open: close one of them")
            return
        browser = _Browser(self._channels)
        self._open.add(browser)
        sender = asyncio.create_task(self._send_all(websocket, browser))
        try:
            await self._receive_all(websocket, browser)
        finally:
            self._open.discard(browser)
            sender.cancel()
            await asyncio.wait([sender])

    async def _send_all(self, websocket: WebSocket, browser: _Browser) -> None:
        while True:
            browser.wake.clear()
            found = browser.take(self._on_request)
            if found is None:
                await browser.wake.wait()
                continue
            try:
                async with asyncio.timeout(ANSWER_S):
                    await self._send(websocket, browser, *found)
            except TimeoutError:
                await self._disconnect(websocket, GOING_AWAY, "no answer")
                return
            except (WebSocketDisconnect, RuntimeError, OSError):  # it has gone; receiving ends, too
                return

    async def _send(self, websocket: WebSocket, browser: _Browser, channel: BrowserChannel, message: Encoded) -> None:
        seen, browser.seen[channel.name] = browser.seen[channel.name], channel.version
        if isinstance(channel, Newest) and seen:
            self.skipped[channel.name] += channel.version - seen - 1
        self.sent[channel.name] += 1
        browser.answered.clear()
        browser.waiting, sent_s = True, time.monotonic()
        if isinstance(message, str):
            await websocket.send_text(message)
        else:
            await websocket.send_bytes(message)
        await browser.answered.wait()
        self.answer.add(time.monotonic() - sent_s)

    async def _receive_all(self, websocket: WebSocket, browser: _Browser) -> None:
        """Take answers and requests until the browser goes, or sends anything else."""
        while True:
            event = await websocket.receive()
            if event["type"] != "websocket.receive":
                return
            if not self._handle(event.get("text") or "", browser):
                await self._disconnect(websocket, POLICY_VIOLATION, "unexpected message")
                return

    def _handle(self, text: str, browser: _Browser) -> bool:
        """Handle a message of a browser; return False for one that no page sends."""
        verb, _, name = text.partition(" ")
        if text == ANSWER and browser.waiting:
            browser.waiting = False
            browser.answered.set()
            return True
        if verb in ("show", "hide") and name in self._on_request and browser.requests < MOST_REQUESTS:
            browser.requests += 1
            if verb == "show":
                browser.wanted.add(name)
            else:
                browser.wanted.discard(name)
            browser.wake.set()
            return True
        return False

    async def _disconnect(self, websocket: WebSocket, code: int, reason: str) -> None:
        self.closed[reason] += 1
        with suppress(WebSocketDisconnect, RuntimeError, OSError):
            await websocket.close(code, reason)
