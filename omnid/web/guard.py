"""The outermost layer of the server: refuses what may not enter, and adds the headers that protect the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, Final

from omnid.web.access import Access
from omnid.web.places import ConnectionPlaces

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),  # with no-referrer browsers hide the origin of the page's own requests
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)
_POLICY_VIOLATION: Final = 1008


class Guard:
    """ASGI middleware; refused: number of refused requests by reason."""

    def __init__(self, app: App, access: Access) -> None:
        self._app, self._access = app, access
        self.refused: Counter[str] = Counter()
        self.places = ConnectionPlaces()  # of the connections over which requests come

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._access.refusal(scope)
        if refusal is None:
            if self._access.has_token(scope):
                self.places.know(scope.get("client"))
            await self._app(scope, receive, _protected(send) if scope["type"] == "http" else send)
            return
        self.refused[refusal.reason] += 1
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": refusal.reason})
            return
        body = f"omnid web: {refusal.text}\n".encode()
        headers = [
            (b"content-type", b"text/plain; charset=utf-8"),
            (b"content-length", str(len(body)).encode()),
            (b"connection", b"close"),
        ]
        protected = _protected(send)
        await protected({"type": "http.response.start", "status": refusal.status, "headers": headers})
        await protected({"type": "http.response.body", "body": body})


def _protected(send: Send) -> Send:
    """Return a function that sends a response with the headers that protect the page."""

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", []))
            names = {name for name, _ in headers}
            added = [*_HEADERS, (b"content-security-policy", POLICY.encode())]
            message["headers"] = headers + [(name, value) for name, value in added if name not in names]
        await send(message)

    return send_with_headers
