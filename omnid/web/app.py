"""The addresses of the server."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from omnid.errors import OmnidError
from omnid.web.access import Access
from omnid.web.feed import RobotFeed
from omnid.web.guard import REPORT_POLICY, Guard
from omnid.web.metrics import CONTENT_TYPE, metrics
from omnid.web.recordings import Recordings
from omnid.web.wheel_commands import Answer, WheelCommands

STATIC: Final = Path(__file__).with_name("static")
COOKIE_S: Final = 30 * 86_400  # for which a browser keeps the cookie
_LONGEST_FORM: Final = 1024  # bytes
_FORM_S: Final = 5.0


class Page:
    """The answers to requests that the guard has let in."""

    def __init__(self, feed: RobotFeed, access: Access, recordings: Recordings, secure: bool) -> None:
        """secure: True if the server speaks TLS, so that browsers send the cookie over TLS only."""
        self._feed, self._access, self._recordings, self._secure = feed, access, recordings, secure
        self._wheels = WheelCommands(feed)
        routes = [
            Route("/", self._index), Route("/login", self._login, methods=["POST"]),
            Route("/stop", self._stop, methods=["POST"]), Route("/arm", self._arm, methods=["POST"]),
            Route("/recordings", self._list), Route("/recordings/{key}/report", self._report, methods=["GET", "POST"]),
            Route("/metrics", self._metrics), WebSocketRoute("/live", self._live),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        self.guard = Guard(Starlette(routes=routes), access)

    async def _index(self, request: Request) -> Response:
        """Return the page; that which asks for the token without it; let a browser in that names the token."""
        token = request.query_params.get("token")
        if token is not None:
            return self._let_in(token)
        if self._access.has_token(request.scope):
            return FileResponse(STATIC / "index.html")
        return FileResponse(STATIC / "login.html", status_code=401)

    async def _login(self, request: Request) -> Response:
        """Let a browser in that sends the token in a form."""
        form = bytearray()
        try:
            async with asyncio.timeout(_FORM_S):
                async for chunk in request.stream():
                    form += chunk
                    if len(form) > _LONGEST_FORM:
                        return PlainTextResponse("omnid web: this is no token\n", 413)
        except TimeoutError:
            return PlainTextResponse("omnid web: the form did not come\n", 408)
        return self._let_in(parse_qs(form.decode("latin-1"), max_num_fields=4).get("token", [""])[0])

    def _let_in(self, token: str) -> Response:
        """Return the answer to a token: the address of the page, with a cookie that takes the token's place."""
        if not self._access.is_token(token):
            self.guard.refused["wrong token"] += 1
            return FileResponse(STATIC / "login.html", status_code=401)
        response = RedirectResponse("/", 303)
        response.set_cookie(self._access.cookie, self._access.cookie_value, max_age=COOKIE_S, httponly=True,
                            samesite="lax", secure=self._secure)
        return response

    async def _live(self, websocket: WebSocket) -> None:
        await self._feed.browsers.serve(websocket)

    async def _stop(self, _: Request) -> Response:
        return _answered(await self._wheels.stop())

    async def _arm(self, _: Request) -> Response:
        return _answered(await self._wheels.arm())

    async def _list(self, _: Request) -> Response:
        return JSONResponse(await asyncio.to_thread(self._recordings.described))

    async def _report(self, request: Request) -> Response:
        """POST: make the report, answered when it is ready; GET: show it."""
        try:
            page = await self._recordings.report(request.path_params["key"])
        except OmnidError as error:
            return JSONResponse({"done": False, "text": str(error)}, 409)
        if request.method == "POST":
            return JSONResponse({"done": True, "text": ""})
        return FileResponse(page, media_type="text/html", headers={"Content-Security-Policy": REPORT_POLICY})

    async def _metrics(self, _: Request) -> Response:
        counts = {"dropped": self._feed.inbox.dropped, "stops": self._wheels.stops, "arms": self._wheels.arms}
        text = metrics(self._feed.state, self._feed.browsers, self.guard.refused, counts)
        return PlainTextResponse(text, media_type=CONTENT_TYPE)


def _answered(answer: Answer) -> Response:
    return JSONResponse(answer._asdict(), 200 if answer.done else 409)
