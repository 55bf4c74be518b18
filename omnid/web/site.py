"""The outer addresses of the server: the form for the token, files, metrics; around the pages of robots."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from omnid.web.access import COOKIE_S, Access
from omnid.web.guard import Guard
from omnid.web.metrics import CONTENT_TYPE

STATIC: Final = Path(__file__).with_name("static")
_LONGEST_FORM: Final = 1024  # bytes
_FORM_S: Final = 5.0


class Site:
    """The answers to requests that the guard has let in."""

    def __init__(
        self, routes: Sequence[BaseRoute], metrics: Callable[[Guard], str], access: Access, secure: bool
    ) -> None:
        """routes: addresses of the robot's page.

        secure: True if the server speaks TLS, so that browsers send the cookie over TLS only.
        """
        self._metrics_text, self._access, self._secure = metrics, access, secure
        outer = [
            Route("/", self._index),
            Route("/login", self._login, methods=["POST"]),
            Route("/logout", self._logout, methods=["POST"]),
            Route("/metrics", self._metrics),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        self.guard = Guard(Starlette(routes=[*outer, *routes]), access)

    async def _index(self, request: Request) -> Response:
        """Return the page; that which asks for the token without it; let a browser in that names the token."""
        token = request.query_params.get("token")
        if token is not None:
            return self._let_in(token)
        if self._access.has_token(request.scope):
            return FileResponse(STATIC / "index.html")
        return FileResponse(STATIC / "login.html", status_code=401)

    async def _logout(self, request: Request) -> Response:
        """End the session of a browser."""
        self._access.end_session(request.scope)
        response = RedirectResponse("/", 303)
        response.delete_cookie(self._access.cookie, httponly=True, samesite="lax", secure=self._secure)
        return response

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
        try:
            fields = parse_qs(form.decode("latin-1"), max_num_fields=4)
        except ValueError:  # more fields
            return PlainTextResponse("omnid web: this is no token\n", 413)
        return self._let_in(fields.get("token", [""])[0])

    def _let_in(self, token: str) -> Response:
        """Return the answer to a token: the address of the page, with a cookie that takes the token's place."""
        role = self._access.role_of(token)
        if role is None:
            self.guard.refused["wrong token"] += 1
            return FileResponse(STATIC / "login.html", status_code=401)
        response = RedirectResponse("/", 303)
        response.set_cookie(
            self._access.cookie,
            self._access.new_cookie(role),
            max_age=COOKIE_S,
            httponly=True,
            samesite="lax",
            secure=self._secure,
        )
        return response

    async def _metrics(self, _: Request) -> Response:
        return PlainTextResponse(self._metrics_text(self.guard), media_type=CONTENT_TYPE)
